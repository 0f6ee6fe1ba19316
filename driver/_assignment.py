"""Linear assignment by shortest augmenting paths (Hungarian method; Jonker and Volgenant 1987).

SciPy's ``linear_sum_assignment`` does the same, but a kernel cannot call it.
"""

from __future__ import annotations

import numpy as np

from ..common.compiled import Places, Rows, loop


@loop
def assign(costs: Rows, chosen: Places) -> None:
    """Choose as many pairs of a row and a column as there can be, at the least total cost.

    Args:
        costs: (n, m), finite.
        chosen: (n,) the column of each row is written; -1: none.

    """
    rows, columns = costs.shape
    wide = rows <= columns
    count, most = (rows, columns) if wide else (columns, rows)
    # Dual variables; index 0 stands for the free end of a path.
    of_row, of_column, least = np.zeros(count + 1), np.zeros(most + 1), np.empty(most + 1)
    partner, before, used = np.zeros(most + 1, np.intp), np.zeros(most + 1, np.intp), np.empty(most + 1, np.bool_)
    for i in range(1, count + 1):
        partner[0] = i
        for j in range(most + 1):
            least[j], used[j] = np.inf, False
        at = 0
        while True:
            used[at] = True
            row, step, following = partner[at], np.inf, 0
            for j in range(1, most + 1):
                if used[j]:
                    continue
                cost = costs[row - 1, j - 1] if wide else costs[j - 1, row - 1]
                reduced = cost - of_row[row] - of_column[j]
                if reduced < least[j]:
                    least[j], before[j] = reduced, at
                if least[j] < step or following == 0:
                    step, following = least[j], j
            for j in range(most + 1):
                if used[j]:
                    of_row[partner[j]] += step
                    of_column[j] -= step
                else:
                    least[j] -= step
            at = following
            if partner[at] == 0:
                break
        while at != 0:
            partner[at] = partner[before[at]]
            at = before[at]
    for i in range(rows):
        chosen[i] = -1
    for j in range(1, most + 1):
        if partner[j] > 0:
            if wide:
                chosen[partner[j] - 1] = j - 1
            else:
                chosen[j - 1] = partner[j] - 1
