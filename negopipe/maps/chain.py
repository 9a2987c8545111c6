"""Pieces of road that both directions use, chained to the longest street."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from negopipe.errors import UserError
from negopipe.maps.line import arc_lengths, rough_middle
from negopipe.maps.street import Array

LARGEST_TURN = np.pi / 3
"""Largest change of direction from one piece to the next, and within a piece of a junction."""
JUNCTION_M = 30.0
"""Length up to which a piece that turns by more than the largest turn is one of a junction, not of a street."""
END_M = 5.0
"""Length of a piece's end over which its direction is taken."""
MOST_VISITS = 200_000
"""Pieces visited in the search for the longest street; a larger map gives the longest one found until then."""


@dataclass(frozen=True)
class Piece:
    """Stretch of road for both directions, seen in one of them.

    key     name of the piece in this direction; twin: that of the same stretch in the other one
    ids     the file's lanelets in it, the one in the direction of the piece first
    left    [N, 2] and right [M, 2]: kerbs, both in the direction of the piece
    next    keys of the pieces that may follow
    is_backward     whether the piece is one lanelet seen against its own direction
    """

    key: Hashable
    twin: Hashable
    ids: tuple[int, ...]
    left: Array
    right: Array
    next: tuple[Hashable, ...]
    is_backward: bool

    @property
    def middle(self) -> Array:
        return rough_middle([self.left], [self.right])

    @property
    def length_m(self) -> float:
        return float(arc_lengths(self.middle)[-1])


def longest_street(path: Path, pieces: Mapping[Hashable, Piece], ids: Sequence[int]) -> list[Piece]:
    """Longest chain of pieces without a turn-off; with `ids`, the chain of exactly the pieces of these lanelets."""
    if ids:
        known = {i for piece in pieces.values() for i in piece.ids}
        missing = sorted(set(ids) - known)
        if missing:
            raise UserError(
                f"{path}: lanelet {missing[0]} is not one that both directions use; {_few(known)} are allowed"
            )
        chosen = {key: piece for key, piece in pieces.items() if set(piece.ids) & set(ids)}
    else:
        chosen = {key: piece for key, piece in pieces.items() if not _turns_off(piece)}
    if not chosen:
        raise UserError(f"{path}: has no two-way street; lanelets for both directions, or opposing ones, are needed")
    chain = _longest_chain(chosen, may_turn=bool(ids))
    if ids and {piece.key for piece in chain} | {piece.twin for piece in chain} != set(chosen):
        raise UserError(f"{path}: lanelets {_few(set(ids))} do not follow one another; those of one street are allowed")
    return _in_order_of(chain, chosen, ids)


def _few(ids: set[int]) -> str:
    first = ", ".join(str(i) for i in sorted(ids)[:12])
    return first if len(ids) <= 12 else f"{first}, ... ({len(ids)} lanelets)"


def _in_order_of(chain: list[Piece], pieces: Mapping[Hashable, Piece], ids: Sequence[int]) -> list[Piece]:
    """The chain in the direction that meets the first named lanelet first, a single piece along that lanelet.

    Where none is named, in the direction whose first lanelet has the smaller id.
    """
    ways = [chain]
    if all(piece.twin in pieces for piece in chain):
        ways.append([pieces[piece.twin] for piece in reversed(chain)])

    def order(way: list[Piece]) -> tuple[int, bool]:
        lanelets = [piece.ids[0] for piece in way]
        if not ids:
            return lanelets[0], way[0].is_backward
        place = next(n for n, piece in enumerate(way) if ids[0] in piece.ids)
        return place, lanelets[place] != ids[0] or way[place].is_backward

    return min(ways, key=order)


def _end_direction(middle: Array, at_end: bool) -> Array:
    along = arc_lengths(middle)
    near = min(END_M, along[-1] / 2)
    from_m, to_m = (along[-1] - near, along[-1]) if at_end else (0.0, near)
    places = np.stack([np.interp([from_m, to_m], along, middle[:, axis]) for axis in (0, 1)], axis=-1)
    step = places[1] - places[0]
    return np.asarray(step / max(float(np.linalg.norm(step)), 1e-9))


def _turns(one: Array, other: Array) -> bool:
    return bool(one @ other < np.cos(LARGEST_TURN))


def _turns_off(piece: Piece) -> bool:
    """Whether a short piece turns so much that it is one of a junction."""
    middle = piece.middle
    return piece.length_m < JUNCTION_M and _turns(_end_direction(middle, False), _end_direction(middle, True))


def _longest_chain(pieces: Mapping[Hashable, Piece], may_turn: bool) -> list[Piece]:
    """Longest chain without a piece twice, in either direction, by depth-first search from every piece."""
    length = {key: piece.length_m for key, piece in pieces.items()}
    begin = {key: _end_direction(piece.middle, False) for key, piece in pieces.items()}
    end = {key: _end_direction(piece.middle, True) for key, piece in pieces.items()}
    after = {
        key: [n for n in piece.next if n in pieces and (may_turn or not _turns(end[key], begin[n]))]
        for key, piece in pieces.items()
    }
    best: tuple[float, list[Hashable]] = (0.0, [])
    visits = 0
    todo: list[tuple[float, list[Hashable]]] = [(length[key], [key]) for key in pieces]
    while todo and visits < MOST_VISITS:
        visits += 1
        total, way = todo.pop()
        best = max(best, (total, way), key=lambda found: round(found[0], 3))
        used = set(way) | {pieces[key].twin for key in way}
        todo += [(total + length[n], [*way, n]) for n in after[way[-1]] if n not in used]
    return [pieces[key] for key in best[1]]
