"""`python -m stickslip_measure`."""

import sys

from stickslip_measure.cli import main

sys.exit(main())
