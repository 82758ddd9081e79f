"""Makes the synchronous client from the asyncio one.

python tools/synchronous_client.py            write hdbridge/client/axis.py and sync.py
python tools/synchronous_client.py --check    exit 1 if they are not up to date

A line that ends in `# async only` is left out. A line `# sync: CODE` becomes CODE.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import generated

CLIENT = generated.ROOT / "hdbridge" / "client"
MADE = {"aioaxis.py": "axis.py", "aio.py": "sync.py"}
NOTE = "# Made by tools/synchronous_client.py from {}: edit that file.\n"
REPLACED = [
    (r"^.*# async only\n", ""),
    (r"# sync: ", ""),
    (r"(?<![\w\]])\(await ((?:[^()]|\((?:[^()]|\([^()]*\))*\))*)\)", r"\1"),
    (r"\b(?:async|await) ", ""),
    (r"asyncio\.sleep", "time.sleep"),
    (r"asyncio\.(Event|Lock)", r"threading.\1"),
    (r"transport\.waited\(ended, (.*)\)", r"ended.wait(\1)"),
    (r"websockets\.asyncio", "websockets.sync"),
    (r"client\.aioaxis\b", "client.axis"),
    (r"client\.aio\b", "client.sync"),
    (r"enter_async_context", "enter_context"),
    (r"__a(enter|exit)__", r"__\1__"),
    (r"\baclose\b", "close"),
    (r"asynccontextmanager", "contextmanager"),
    (r"asyncio client", "synchronous client"),
    (r"Async(?=[A-Z])", ""),
]


def synchronous(name: str) -> str:
    """Returns the synchronous text of an asyncio module of the client, formatted."""
    text = (CLIENT / name).read_text(encoding="utf-8")
    for pattern, new in REPLACED:
        text = re.sub(pattern, new, text, flags=re.MULTILINE)
    for command in (["check", "--select", "I", "--fix"], ["format"]):
        ruff = [str(Path(sys.executable).with_name("ruff")), *command, "--quiet"]
        text = subprocess.run(
            [*ruff, "--stdin-filename", str(CLIENT / MADE[name]), "-"],
            input=text,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
    return NOTE.format(name) + text


if __name__ == "__main__":
    sys.exit(generated.main({CLIENT / new: synchronous(name) for name, new in MADE.items()}))
