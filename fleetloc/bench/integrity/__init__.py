"""Studies of what can be trusted, and their `commands`: guaranteed sets (`set_membership`), promises under faults
(`study`, its `flights`, and `stanford` diagrams)."""
