"""Workers run tasks: the dispatcher is a Ray driver, and the stages are functions."""
