"""The REST interface: each route reads its request, asks the coordinator, and answers."""
