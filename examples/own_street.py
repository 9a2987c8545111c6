"""A drive on the street of a CommonRoad file, as a film.

    python examples/own_street.py street.xml film.gif

The street is the longest one of the map, or that of scenario.map.ids; docs/scenarios.md says more.
"""

import sys

from PIL import Image

import negopipe


def main(file: str, film: str, overrides: tuple[str, ...] = ()) -> str:
    """Drive one episode with a horizon of 4 s, write its film and return its outcome."""
    street = ["scenario=commonroad", f"scenario.map.file={file}", *overrides]
    env = negopipe.make_env(street, render_mode="rgb_array")
    env.reset(seed=1)
    frames, is_over = [Image.fromarray(env.render())], False  # type: ignore[arg-type]
    while not is_over:
        _, _, terminated, truncated, info = env.step(2)  # type: ignore[arg-type]
        frames.append(Image.fromarray(env.render()))  # type: ignore[arg-type]
        is_over = terminated or truncated
    frame_ms = round(1000 / env.metadata["render_fps"])
    frames[0].save(film, save_all=True, append_images=frames[1:], duration=frame_ms, loop=0)
    return str(info["outcome"])


if __name__ == "__main__":
    print(main(sys.argv[1], sys.argv[2]))
