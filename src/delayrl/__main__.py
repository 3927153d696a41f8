"""`python -m delayrl` is the command line."""

from delayrl.cli.main import main

main()
