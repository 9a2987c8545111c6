"""Rows of parked cars between which no vehicle fits, from the cars of a street."""

Row = tuple[float, float, float, float]
"""Fields of a `ParkedRow`."""

NO_ROW = (0.0, 0.0, 1.0, 1e3)
"""A row out of reach, for streets with fewer rows than others."""


def parked_rows(cars: list[tuple[float, float, float, float]], is_straight: bool, room_m: float) -> list[Row]:
    """Rows of parked cars: neighbours with less than `room_m` between them; on a bent road every car by itself."""
    rows: list[Row] = []
    for sigma, d, length, width in sorted(cars):
        row = (sigma, length / 2, 1.0 if d > 0 else -1.0, abs(d) - width / 2)
        before = next((r for r in reversed(rows) if r[2] == row[2]), None)
        if is_straight and before and _between(before, row) < room_m:
            rows[rows.index(before)] = _joined(before, row)
        else:
            rows.append(row)
    return rows


def _between(first: Row, second: Row) -> float:
    return second[0] - second[1] - first[0] - first[1]


def _joined(first: Row, second: Row) -> Row:
    start, end = first[0] - first[1], second[0] + second[1]
    return (start + end) / 2, (end - start) / 2, first[2], min(first[3], second[3])
