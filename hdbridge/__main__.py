"""``python -m hdbridge`` is the command line."""

from hdbridge.cli import main

main()
