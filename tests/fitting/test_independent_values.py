"""How many independent values residuals are worth, where their correlation is known."""

from __future__ import annotations

import numpy as np
import pytest

from tvbrdf_fitting.choice.independent_values import correlation, nested_blocks


class TestIndependentValues:
    """Residuals made with a known correlation."""

    POINTS = np.random.default_rng(0).random((1024, 6))
    SEEN = np.ones((3, 1024), dtype=bool)

    def worth(self, residual: np.ndarray, seen: np.ndarray | None = None) -> float:
        blocks = nested_blocks(self.POINTS, np.arange(1024) % 4)
        return correlation(residual, self.SEEN if seen is None else seen, blocks)[0]

    def test_blocks_halve(self) -> None:
        levels = nested_blocks(self.POINTS, np.arange(1024) % 4)
        assert [len(starts) for _, starts in levels] == [4 * 2**i for i in range(8)]
        for order, starts in levels:
            assert sorted(order) == list(range(1024))
            assert (np.diff(starts) == 1024 // len(starts)).all()

    def test_blocks_of_odd_groups(self) -> None:
        groups = np.repeat([1, 2, 5, 7, 9], [1, 2, 3, 50, 944])
        for order, starts in nested_blocks(self.POINTS[:1000], groups):
            assert sorted(order) == list(range(1000))
            assert (np.diff(np.append(starts, 1000)) > 0).all()
            # no block has points of two groups
            assert set(np.flatnonzero(np.diff(groups[order])) + 1) <= set(starts)
        assert nested_blocks(self.POINTS[:3], np.ones(3, dtype=int)) == []

    def test_noise_counts_fully(self) -> None:
        rng = np.random.default_rng(1)
        assert max(self.worth(rng.normal(size=(3, 1024))) for _ in range(20)) < 1.3

    def test_unequal_channels_count_fully(self) -> None:
        rng = np.random.default_rng(2)
        seen = self.SEEN.copy()
        seen[0, 200:] = False
        assert self.worth(np.where(seen, rng.normal(size=(3, 1024)), 0.0), seen) < 1.3
        seen[1:] = False
        assert self.worth(np.where(seen, rng.normal(size=(3, 1024)), 0.0), seen) < 1.3

    def test_channels_that_go_together(self) -> None:
        residual = np.broadcast_to(np.random.default_rng(3).normal(size=1024), (3, 1024))
        assert self.worth(residual) == pytest.approx(3.0, rel=0.25)
        # also where one has another sign, or is alone
        assert self.worth(residual * [[1.0], [-1.0], [1.0]]) == pytest.approx(3.0, rel=0.25)
        assert self.worth(residual * [[1.0], [0.0], [0.0]]) == pytest.approx(3.0, rel=0.25)

    @pytest.mark.parametrize("size", [4, 16, 64])
    def test_neighbours_that_go_together(self, size: int) -> None:
        """Blocks of one value: of `size` values that are alike, one counts."""
        rng = np.random.default_rng(size)
        levels = nested_blocks(self.POINTS, np.arange(1024) % 4)
        order, starts = next(level for level in levels if len(level[1]) == 1024 // size)
        residual = np.empty((3, 1024))
        residual[:, order] = np.repeat(rng.normal(size=(3, len(starts))), size, axis=1)
        # the estimate's edge is conservative for few blocks, its noise the square root of 2 / 3 B
        low = (1 + (3 / len(starts)) ** 0.5) ** -2
        assert 0.8 * low * size < self.worth(residual) < 1.6 * size

    def test_nothing_left(self) -> None:
        assert self.worth(np.zeros((3, 1024))) == 1.0
