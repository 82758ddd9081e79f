"""Blind trials of the diagnosis on records from formulas: `python tools/diagnose_trials.py [seeds]
[only,these]`.

The plant (tests/support/plant.py) shares no code with the effects. Each line is one record. The table at the
end gives right names, wrong names, abstentions, and the time per diagnosis.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from support.trials import CAUSES, NONE, PAIRS, SPECIAL, UNKNOWN, planted, verdict

from hdbridge.analysis.diagnosis import diagnose


def trial(name: str, seed: int) -> tuple[set[str], list[dict[str, object]], float, dict[str, object]]:
    """Returns the true causes, the reported ones, the time taken, and the whole result."""
    there, record, model = planted(name, seed)
    begin = time.process_time()
    result = diagnose(record, model).as_dict()
    return there, result["findings"], time.process_time() - begin, result


def _words(finding: dict[str, object]) -> str:
    aliases = "|" + ",".join(finding["aliases"]) if finding["aliases"] else ""  # type: ignore[arg-type]
    lives = f" in {finding['lives_in']}" if "lives_in" in finding else ""
    return f"{finding['cause']}{aliases} p{finding['probability']:.2f} {finding['peak_arcsec']:.2g}{lives}"


def main() -> None:
    given = sys.argv[1] if len(sys.argv) > 1 else "2"
    first, last = (int(each) for each in given.split("-")) if "-" in given else (0, int(given) - 1)
    names = [*CAUSES, *SPECIAL, *NONE, *UNKNOWN, *PAIRS]
    if len(sys.argv) > 2:
        names = [
            each
            for each in names
            if any(
                each == part or (part[-1] == "*" and each.startswith(part[:-1]))
                for part in sys.argv[2].split(",")
            )
        ]
    counts: dict[str, list[int]] = {}
    for name in names:
        for seed in range(first, last + 1):
            there, findings, seconds, result = trial(name, seed)
            found = {str(each["cause"]): set(each["aliases"]) for each in findings}  # type: ignore[call-overload]
            judged = verdict(name, there, found)
            group = (
                "pair"
                if "+" in name
                else name.partition(":")[0]
                if ":" in name
                else ("none" if name == "none" else "single")
            )
            group = "none other law" if name.startswith("none:") else group
            tally = counts.setdefault(group, [0, 0, 0, 0, 0])
            tally[0] += 1
            tally[1] += judged.all_right
            tally[2] += bool(judged.wrong)
            tally[3] += judged.unexplained
            tally[4] += judged.first_right
            words = "; ".join(map(_words, findings))
            good = "ok  " if judged.all_right and not judged.wrong else "BAD "
            before, after = (result[each]["rms_arcsec"] for each in ("refitted", "extended"))  # type: ignore[index]
            print(
                f"{name:32s} {seed} {good} {words}  rms {before:.3g}->{after:.3g} {seconds:.0f}s", flush=True
            )
            for each in result["considered"]:  # type: ignore[attr-defined]
                print(f"{'':36s}not named: {each}")
    print(f"{'group':16s} records  all right  with a wrong name  with 'unexplained'  first right")
    for group, tally in counts.items():
        print(f"{group:16s} {tally[0]:7d} {tally[1]:10d} {tally[2]:18d} {tally[3]:19d} {tally[4]:12d}")
    print(json.dumps(counts))


if __name__ == "__main__":
    main()
