"""Elites -> certificates: a sum-of-squares proof of every funnel, and a checker that shares no code with the prover."""
