// Texts of the page: figures, fault, model, events.

import { holdsLease } from "./api.js";

const at = (id) => document.getElementById(id);
const EVENTS_SHOWN = 100;
const PROCEDURES = ["calibrate", "step", "improve"];
const GRAVE = new Set(["stopped", "bus-down", "refused", "stream-refused"]);
const number = (value, digits) => (value === null || value === undefined ? "-" : value.toFixed(digits).replace("-", "\u2212"));

export function age(seconds) {
  if (seconds === null || seconds === undefined) return "unknown";
  for (const [unit, length] of [["days", 86400], ["hours", 3600], ["minutes", 60]]) {
    if (seconds >= 2 * length) return `${Math.floor(seconds / length)} ${unit}`;
  }
  return `${Math.floor(seconds)} s`;
}

export function say(error) {
  const notice = at("notice");
  notice.hidden = error === null;
  if (error !== null) notice.textContent = error.message;
}

export function connection(state, text) {
  const line = at("connection");
  line.className = state;
  line.textContent = text;
}

export function tabs(names, chosen, choose) {
  const box = at("axes");
  box.hidden = names.length < 2;
  if (box.childElementCount !== names.length) {
    box.replaceChildren(
      ...names.map((name) => {
        const button = document.createElement("button");
        button.type = "button";
        button.role = "tab";
        button.textContent = name;
        button.onclick = () => choose(name);
        return button;
      }),
    );
  }
  for (const button of box.children) button.setAttribute("aria-selected", String(button.textContent === chosen));
}

/** Newest sample of the axis shown. */
export function figures(axis) {
  at("load").textContent = number(axis.load_position_deg, 4);
  at("target").textContent = number(axis.load_target_deg, 4);
  at("error").textContent = number(axis.error_arcsec, 1);
  at("correction").textContent = number(axis.correction_arcsec, 1);
}

function facts(list, rows) {
  list.replaceChildren(
    ...rows.flatMap(([name, value]) => {
      const term = document.createElement("dt");
      const text = document.createElement("dd");
      term.textContent = name;
      text.textContent = value;
      return [term, text];
    }),
  );
}

function adaptation(state) {
  if (state.mode === "off") return "off";
  const { response } = state;
  const when = response?.date ? ` at ${new Date(response.date).toLocaleString()}` : "";
  return [
    state.mode,
    ...(state.frozen ? [`frozen: ${state.frozen}`] : []),
    ...(response ? [`response in motion refined${when}: ${response.low_hz.toFixed(0)} to ${response.high_hz.toFixed(0)} Hz, by at most ${response.percent.toFixed(0)} % (at ${response.at_hz.toFixed(0)} Hz)`] : []),
  ].join("; ");
}

export function machine(state) {
  document.title = `${state.name}: hdbridge`;
  at("machine").textContent = state.name;
  at("simulated").hidden = !state.simulated;
  const load = state.bus.load;
  at("bus-load").textContent = load === null || load === undefined ? "-" : (100 * load).toFixed(0);
  at("cycle-figures").textContent = `${(1e3 * state.cycle.period_s).toFixed(1)} ms per cycle, ${state.cycle.skipped} skipped`;
  const mine = holdsLease();
  at("holder").textContent = mine ? "you have control" : state.lease.held ? `${state.lease.client || "another client"} has control` : "nobody has control";
  at("lease").textContent = mine ? "Release control" : "Take control";
  at("lease").disabled = false;
  at("controls").disabled = !mine;
  at("reset").disabled = !mine;
  at("controls-why").hidden = mine;
  const warnings = [...state.warnings, ...(state.recorder.note ? [`recorder: ${state.recorder.note}`] : []), ...state.axes.flatMap((each) => each.advice.map((text) => `${each.name}: ${text}`))];
  at("warnings").hidden = warnings.length === 0;
  at("warnings").replaceChildren(...warnings.map((text) => Object.assign(document.createElement("li"), { textContent: text })));
}

/** A path as one word of a shell. */
const quoted = (path) => (/^[\w@%+=:,./-]+$/.test(path) ? path : `'${path.replaceAll("'", "'\"'\"'")}'`);

export function axis(state, simulated) {
  at("state").textContent = state.state;
  at("mode").textContent = state.state === "enabled" ? state.mode : state.power;
  const lag = state.motor_target_deg === null || state.motor_position_deg === null ? null : state.motor_target_deg - state.motor_position_deg;
  at("following").textContent = number(lag, 3);
  at("torque").textContent = number(state.motor_torque_nm, 3);
  at("compensation").textContent = compensation(state);
  at("lent").hidden = state.state !== "lent";
  at("fault").hidden = !state.fault;
  if (state.fault) {
    at("fault-text").textContent = state.fault.text;
    at("fault-hint").textContent = state.fault.hint;
    at("reset").textContent = state.fault.needs_verification ? "Verify the drive and reset" : "Reset";
  }
  const select = at("scheme");
  const offered = ["none", "synchronous", "hysteresis", "both", "extended"];
  if (!select.options.length) select.append(...offered.map((name) => new Option(name, name)));
  if (document.activeElement !== select) select.value = state.scheme;
  at("move-to").min = state.limits.position_min_deg;
  at("move-to").max = state.limits.position_max_deg;
  at("jog-speed").max = state.limits.velocity_deg_s;
  const model = state.model;
  const rows = model
    ? [
        ["version", model.version === null ? "not in the history" : String(model.version)],
        ["made", model.date ? `${new Date(model.date).toLocaleString()} (${age(model.age_s)} ago)` : "unknown"],
        ["why", model.reason || "not told"],
        ["effects", model.effects.join(", ") || "none"],
        ["file", model.file],
      ]
    : [["model", "none: this axis is not compensated"]];
  rows.push(
    ["compensation", compensation(state)],
    ["hysteresis state", state.memory_known ? "known" : "not known until the axis has turned far enough"],
    ["load-side loop", loadLoop(state.load_loop)],
    ["adaptation", adaptation(state.adaptation)],
  );
  if (state.outer) rows.push(["other master", otherMaster(state.outer)]);
  facts(at("model"), rows);
  const lines = PROCEDURES.map((name) => `hdbridge ${name} ${quoted(state.profile)} ${simulated ? "--simulate" : "--borrow"}`);
  const text = [...lines, `hdbridge ctl model ${state.name} pending`].join("\n");
  if (at("commands").textContent !== text) at("commands").textContent = text;
}

const NMT = { 4: "stopped", 5: "operational", 127: "pre-operational" };

function otherMaster(outer) {
  if (!outer.alive) return `node ${outer.node_id}: the gateway process does not run`;
  const word = outer.statusword.toString(16).toUpperCase().padStart(4, "0");
  const sync = outer.period_s === null ? "no SYNC" : `SYNC every ${number(1e3 * outer.period_s, 3)} ms, jitter ${number(1e6 * outer.jitter_s, 0)} \u00b5s`;
  const late = outer.latency_s === null ? "" : `, target to frame ${number(1e3 * outer.latency_s, 1)} ms, 99 % within ${number(1e3 * outer.latency_99_s, 1)} ms`;
  const code = outer.error ? `, error ${outer.error}` : "";
  return `node ${outer.node_id}, ${NMT[outer.nmt] || "starting"}, 6041h = ${word}h${code}, ${sync}${late}`;
}

function compensation(state) {
  if (!state.model) return "off (no model)";
  if (!state.compensating) return state.scheme === "none" ? "off" : `off (${state.scheme} is chosen)`;
  return `${state.scheme}${state.changing ? ", changing" : ""}${state.limited ? ", at its limit" : ""}`;
}

function loadLoop(loop) {
  if (!loop.on) return "off";
  const doubt = loop.doubt === null ? "" : `; does not act: ${loop.doubt}`;
  return `on, ${number(loop.correction_arcsec, 1)} arcsec${doubt}`;
}

export function events(news) {
  const list = at("events");
  for (const event of news) {
    const line = document.createElement("li");
    const time = document.createElement("time");
    time.textContent = new Date(event.date).toLocaleTimeString();
    line.append(time, [event.axis, event.kind, event.text].filter(Boolean).join(": "));
    if (GRAVE.has(event.kind)) line.className = "grave";
    if (event.hint) line.title = event.hint;
    list.prepend(line);
  }
  while (list.childElementCount > EVENTS_SHOWN) list.lastElementChild.remove();
}
