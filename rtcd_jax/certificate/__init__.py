"""Elites -> certificates: a sum-of-squares proof of every funnel, and the checker that needs to believe nobody."""
