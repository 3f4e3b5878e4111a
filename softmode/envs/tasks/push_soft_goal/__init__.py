"""PushSoftGoal: PushSoft, goal-conditioned."""
