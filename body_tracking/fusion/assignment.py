"""Assignment of bodies to people at the least total cost.

``scipy.optimize`` has it too, but takes the node ``fusion`` half of its start to import.
"""

from __future__ import annotations

import numpy as np

from body_tracking.core.skeleton import FloatArray, IntArray


def least_cost_assignment(costs: FloatArray) -> tuple[IntArray, IntArray]:
    """Rows and columns of the assignment with the least sum of costs, by shortest augmenting paths (Crouse 2016).

    Args:
        costs: (n, m) finite.

    Returns:
        (min(n, m),) rows in ascending order, and the column of each.
    """
    if costs.shape[0] > costs.shape[1]:
        columns, rows = least_cost_assignment(costs.T)
        order = np.argsort(rows)
        return rows[order], columns[order]
    count, width = costs.shape
    row_potential, column_potential = np.zeros(count), np.zeros(width)
    row_of: IntArray = np.full(width, -1, dtype=np.intp)
    column_of: IntArray = np.full(count, -1, dtype=np.intp)
    for start in range(count):
        # the shortest path by reduced costs, through assigned columns and their rows, to a free column (Dijkstra)
        distance, via = np.full(width, np.inf), np.full(width, -1, dtype=np.intp)
        final = np.zeros(width, dtype=np.bool_)
        row, reached = start, 0.0
        while True:
            through = reached + costs[row] - row_potential[row] - column_potential
            shorter = ~final & (through < distance)
            distance[shorter], via[shorter] = through[shorter], row
            column = int(np.argmin(np.where(final, np.inf, distance)))
            reached = float(distance[column])
            if row_of[column] < 0:
                break
            final[column], row = True, int(row_of[column])
        row_potential[start] += reached
        row_potential[row_of[final]] += reached - distance[final]
        column_potential[final] -= reached - distance[final]
        while column >= 0:  # shift the assignments along the path
            row = int(via[column])
            row_of[column] = row
            column_of[row], column = column, int(column_of[row]) if row != start else -1
    return np.arange(count, dtype=np.intp), column_of
