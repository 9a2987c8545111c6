"""Learning: rollout, advantages, update; on tensors only, for any environment that steps in batches.

rollout.py         the interface of an environment, and rollouts of T steps in E worlds
advantage.py       returns and advantages: k steps (Eq. 6), or GAE
learner.py         the updates of the policy from a rollout, by the algorithm of the config
update.py          the parts of all algorithms: minibatch, losses, measured KL
acktr.py           natural gradient within trust regions
acktr_adam.py      natural gradient with Adam as the step rule
a2c.py, ppo.py     gradient of a loss with Adam (adam.py)
kfac.py            Kronecker-factored Fisher matrix and natural gradient
demonstrations.py  demonstrated decisions beside the policy's own
"""
