"""Tables, transactions, migrations and pages of rows."""
