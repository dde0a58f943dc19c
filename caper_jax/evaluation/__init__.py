"""How good estimates are: errors, the protocol that produces them, and the report."""
