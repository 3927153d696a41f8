"""`python -m delayrl` is the command line."""

from delayrl.cli import main

main()
