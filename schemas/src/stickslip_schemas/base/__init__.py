"""The base of every document, content keys and states."""
