// The buttons, their requests to the daemon, and the lease.

import { ask, axisPath, holdsLease, releaseLease, renewLease, takeLease } from "./api.js";

const RENEW_MS = 1000;
const JOG_MS = 100;
const JOG_TIMEOUT_S = 0.4; // the loop brakes by itself when the page, the network or the finger is gone
const at = (id) => document.getElementById(id);

export class Controls {
  /** chosen() returns the name of the axis shown; say(error) shows an error; changed() is called after each answer. */
  constructor(chosen, say, changed) {
    this.chosen = chosen;
    this.say = say;
    this.changed = changed;
    this.jogging = null;
    at("lease").onclick = () => this.toggleLease();
    at("quick-stop").onclick = () => this.quickStop();
    at("reset").onclick = () => this.send("reset");
    at("enable").onclick = () => this.send("enable");
    at("disable").onclick = () => this.send("disable");
    at("stop").onclick = () => this.send("stop");
    at("scheme").onchange = (event) => this.send("compensate", { scheme: event.target.value });
    at("move-form").onsubmit = (event) => {
      event.preventDefault();
      const target = at("move-to").valueAsNumber;
      if (Number.isFinite(target)) this.send("move", { target_deg: target, wait: false });
    };
    for (const [id, sign] of [["jog-up", 1], ["jog-down", -1]]) {
      const button = at(id);
      button.onpointerdown = (event) => {
        button.setPointerCapture(event.pointerId);
        this.jog(sign);
      };
      for (const end of ["onpointerup", "onpointercancel", "onlostpointercapture", "onblur"]) button[end] = () => this.endJog();
      button.onkeydown = (event) => {
        if (event.key === " " || event.key === "Enter") {
          event.preventDefault();
          if (!event.repeat) this.jog(sign);
        }
      };
      button.onkeyup = () => this.endJog();
    }
    document.addEventListener("keydown", (event) => this.key(event));
    document.addEventListener("keyup", (event) => event.key.startsWith("Arrow") && this.endJog());
    window.addEventListener("blur", () => this.endJog());
    window.addEventListener("pagehide", () => this.endJog());
    setInterval(() => holdsLease() && this.try(renewLease), RENEW_MS);
  }

  async try(request) {
    try {
      return await request();
    } catch (error) {
      this.endJog();
      this.say(error);
      return null;
    } finally {
      this.changed();
    }
  }

  send(what, body) {
    this.say(null);
    return this.try(() => ask("POST", axisPath(this.chosen(), what), body));
  }

  quickStop() {
    this.endJog();
    return this.try(() => ask("POST", "/quick-stop"));
  }

  toggleLease() {
    this.say(null);
    if (holdsLease()) return this.try(releaseLease);
    return this.try(async () => {
      try {
        await takeLease(false);
      } catch (error) {
        if (error.status !== 423 || !confirm(`${error.message}\n\nTake control all the same? Motion of the other client is stopped.`)) throw error;
        await takeLease(true);
      }
    });
  }

  jog(sign) {
    if (this.jogging || !holdsLease()) return;
    this.say(null);
    const speed = sign * Math.abs(at("jog-speed").valueAsNumber || 0);
    const axis = this.chosen();
    let waiting = false;
    const again = async () => {
      if (waiting) return; // one at a time: a slow line must not pile up orders to move
      waiting = true;
      await this.try(() => ask("POST", axisPath(axis, "jog"), { velocity_deg_s: speed, timeout_s: JOG_TIMEOUT_S }));
      waiting = false;
    };
    this.jogging = { axis, timer: setInterval(again, JOG_MS) };
    again();
  }

  endJog() {
    if (!this.jogging) return;
    const { axis, timer } = this.jogging;
    clearInterval(timer);
    this.jogging = null;
    this.try(() => ask("POST", axisPath(axis, "stop")));
  }

  key(event) {
    if (event.key === "Escape") {
      event.preventDefault();
      this.quickStop();
      return;
    }
    if (/^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName) || event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
    if (event.key === "s" || event.key === "S") this.send("stop");
    else if (event.key === "ArrowRight") this.jog(1);
    else if (event.key === "ArrowLeft") this.jog(-1);
    else if (/^[1-9]$/.test(event.key)) document.querySelectorAll("#axes button")[Number(event.key) - 1]?.click();
  }
}
