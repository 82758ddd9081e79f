"""A master that enables the drive and moves it until a test kills it."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from conftest import master_on

with master_on(sys.argv[1], Path(sys.argv[2])) as master:
    master.boot()
    master.run(50)
    print("moving", flush=True)
    while True:
        master.move()
