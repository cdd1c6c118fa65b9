"""`python -m rotorgram` is the command `rotorgram`."""

import sys

from .cli import main

sys.exit(main())
