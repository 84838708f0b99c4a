"""`python -m restock`."""

import sys

from restock.cli import main

sys.exit(main())
