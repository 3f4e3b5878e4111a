"""RopeRoute: lead a soft rope around pegs to a goal."""
