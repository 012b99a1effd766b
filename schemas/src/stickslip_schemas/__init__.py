"""The contract of stickslip: the documents that its parts exchange, one concept a module."""
