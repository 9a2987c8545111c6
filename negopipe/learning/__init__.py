"""Learning: roll out, estimate advantages, update. Tensors only, any environment that steps in batches.

rollout.py      what an environment must offer, and collecting T steps of E worlds
advantage.py    returns and advantages: k steps (Eq. 6), or GAE
learner.py      from a rollout to updates, by the algorithm of the config
update.py       what all algorithms share: the minibatch, its losses, the measured KL
acktr.py        natural gradient within trust regions
acktr_adam.py   natural gradient, stepped along by Adam
a2c.py, ppo.py  Adam down a loss (adam.py)
kfac.py         Kronecker-factored Fisher matrix and the natural gradient
"""
