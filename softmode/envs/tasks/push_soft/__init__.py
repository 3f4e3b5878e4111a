"""PushSoft: push a soft object over the table to a goal."""
