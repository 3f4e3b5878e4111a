"""Training of policies: PPO on vectorised environments, runs that resume, policies that load anywhere.

Importing this package loads nothing heavy; its modules need torch (``pip install 'softmode[rl]'``).
"""
