"""Who may do what, who has done what, and which programs receive job events."""
