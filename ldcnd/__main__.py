"""`python -m ldcnd`."""

from ldcnd.cli.main import main

main()
