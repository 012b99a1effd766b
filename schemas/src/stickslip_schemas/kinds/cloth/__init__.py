"""What all kinds of cloth share."""
