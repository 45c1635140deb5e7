"""How tasks are stepped: one at a time by dm_control, or many at once."""
