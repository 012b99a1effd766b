"""What holds for the tests of all components."""

import os

os.environ.pop("STICKSLIP_DATABASE", None)  # no test is to write into a database that is in use
