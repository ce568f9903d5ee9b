"""Studies of what can be trusted: guaranteed sets (`set_membership`), and their commands (`commands`)."""
