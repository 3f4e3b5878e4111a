"""LiftSoft: pick a soft object from a table and hold it at a goal."""
