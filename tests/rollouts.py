"""Rollouts in numbers, for tests that learn."""

from negopipe.learning.rollout import Rollout


def episode_statistics(rollout: Rollout) -> dict[str, float]:
    """How the episodes went that ended within the rollout; only their number where none did.

    Keys: n_episodes, return_mean, steps_mean, success_rate, collision_rate.
    """
    is_done = rollout.is_terminated | rollout.is_truncated
    n_episodes = int(is_done.sum())
    if n_episodes == 0:
        return {"n_episodes": 0.0}
    return {
        "n_episodes": float(n_episodes),
        "return_mean": float(rollout.episode_return[is_done].mean()),
        "steps_mean": float(rollout.episode_steps.sum()) / n_episodes,
        "success_rate": float(rollout.is_success.sum()) / n_episodes,
        "collision_rate": float(rollout.is_collision.sum()) / n_episodes,
    }
