"""LiftSoftGoal: LiftSoft, goal-conditioned."""
