"""`python -m hilcal`: the command line."""

from hilcal.cli import main

main()
