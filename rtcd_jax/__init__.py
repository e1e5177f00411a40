"""Robust co-design of robots: designs, cost weights and funnels, whole populations at once.

The data flow, one module a step; every step is written for one candidate and mapped over the population once:

    genome -> Candidate -> Trajectory -> Policy -> Funnel -> Volumes
              population   trajectory    policy    funnel    volume

`evaluation` chains the steps, `search` asks CMA-ES for genomes and keeps the elites, `rtcd` is the command line.
"""
