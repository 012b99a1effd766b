"""Master curves, from the equations of the continuous rod, strip and plate."""
