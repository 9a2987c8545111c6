"""Learning: roll out, estimate advantages, update. Tensors only, any environment that steps in batches.

rollout.py      what an environment must offer, and collecting T steps of E worlds
advantage.py    k-step returns and advantages (Eq. 6)
kfac.py         Kronecker-factored Fisher matrix and the natural gradient
acktr.py        one ACKTR update
"""
