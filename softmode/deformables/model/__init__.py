"""Bodies in a Newton model, and the tables that a step reads and writes."""
