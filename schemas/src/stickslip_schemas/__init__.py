"""The contract of stickslip: what its parts say to each other. See the modules, one concept each."""
