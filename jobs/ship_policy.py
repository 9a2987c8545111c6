"""Add a trained policy to those that come with negopipe: python jobs/ship_policy.py <checkpoint> <name>

The encoder of a network of grids is rounded to bfloat16, which halves the file. A policy that was trained in bfloat16
computes with exactly these weights. A network of objects is small and stays as it is. The shipped policy is the one to
evaluate: +experiment=<name> checkpoint=pretrained.
"""

import argparse
from pathlib import Path

import torch

from negopipe.tracking import pretrained
from negopipe.tracking.checkpoint import load_checkpoint, save_checkpoint


def ship(checkpoint: Path, name: str) -> Path:
    """Write a checkpoint into the package under a name; returns its path."""
    tensors, metadata = load_checkpoint(checkpoint)
    is_small = metadata.get("policy", {}).get("kind") == "objects"
    rounded = {
        key: x.to(torch.bfloat16) if key.startswith("encoder.") and not is_small else x for key, x in tensors.items()
    }
    path = pretrained.FOLDER / f"{name}.safetensors"
    path.parent.mkdir(exist_ok=True)
    save_checkpoint(path, rounded, metadata)
    return path


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path, help="checkpoint.safetensors of a run")
    parser.add_argument("name", help="name of its experiment, by which checkpoint=pretrained finds it")
    arguments = parser.parse_args()
    print(ship(arguments.checkpoint, arguments.name))
