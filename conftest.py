"""What holds for the tests of all components."""

import os

for _name in ("STICKSLIP_DATABASE", "STICKSLIP_STORE"):  # no test is to write into what is in use
    os.environ.pop(_name, None)
