"""The paper's tables, measured again: its figures as data, and what draws ours beside them."""
