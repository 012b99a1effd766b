"""HTTP: routes, documents, problems, event streams."""
