"""Adapters that come with the package: contract.py says what an adapter is.

NAME.py is run in the environment of its simulator, and never imported here. `NAME.requirements.txt`
lists what that environment needs beside NumPy.
"""
