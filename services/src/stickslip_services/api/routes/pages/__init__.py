"""Pages for people: the dashboard at `/`.

They are not part of the API and may change at any time.
"""
