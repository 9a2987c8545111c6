"""Put a trained policy among those that come with negopipe: python jobs/ship_policy.py <checkpoint> <name>

The encoder is rounded to bfloat16, which halves the file; a policy that was trained in bfloat16 computes with just
these weights. Evaluate what was shipped, not what it was made from: +experiment=<name> checkpoint=pretrained.
"""

import argparse
from pathlib import Path

import torch

from negopipe.tracking import pretrained
from negopipe.tracking.checkpoint import load_checkpoint, save_checkpoint


def ship(checkpoint: Path, name: str) -> Path:
    """Keep a checkpoint in the package under a name; returns the file."""
    tensors, metadata = load_checkpoint(checkpoint)
    rounded = {key: x.to(torch.bfloat16) if key.startswith("encoder.") else x for key, x in tensors.items()}
    path = pretrained.FOLDER / f"{name}.safetensors"
    path.parent.mkdir(exist_ok=True)
    save_checkpoint(path, rounded, metadata)
    return path


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path, help="checkpoint.safetensors of a run")
    parser.add_argument("name", help="of the experiment it is for: checkpoint=pretrained finds it by that")
    arguments = parser.parse_args()
    print(ship(arguments.checkpoint, arguments.name))
