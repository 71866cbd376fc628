"""Which rung of a ladder is kept, given what all of them leave of the data.

A rung beats one with fewer or as many parameters where its criterion is lower by `DECISIVE`
and, if no rung explains the data within their noise, its root mean square error is smaller by
`MATTERS`: better fits of what remains wrong must matter in practice. The simplest rung that none
beats, and that has a lower criterion than every simpler one, is kept. Of rungs with as many
parameters the ladder's first counts as the simplest where noise explains the data, so that noise
does not decide on the shape of a lobe; else the one with the lower criterion. Three guards:

- A rung with an undetermined parameter needs twice as much against each simpler one.
- Where no rung explains the data, a lobe must be a highlight: at least `HIGHLIGHT` of its squared
  radiance must be what diffuse parts can't make, or the error must be less than half (`DOMINANT`)
  of that without lobes. A broad lobe takes up a diffuse part's error. And a rung with a highlight
  must beat every simpler one with lobes but without a highlight.
- With `previous`, another rung is kept only where the evidence is clear: a richer one if it is
  better by `SWITCH` in the criterion and by twice `MATTERS`; a simpler one if what the previous
  rung gains in squares is below half of what its parameters cost, or its error is smaller by less
  than half of `MATTERS`. Between the two, the choice stays as it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from .ladder import Candidate

DECISIVE = 10.0
"""Difference of criteria that decides: "very strong" evidence (Kass and Raftery, 1995)."""
MATTERS = 0.1
"""Relative decrease of the error that matters where no rung explains the data."""
HIGHLIGHT = 0.25
"""Share of a lobe that diffuse parts can't make: a variance inflation of 4."""
DOMINANT = 0.5
"""Relative decrease of the error that no error of a diffuse part makes up."""
SWITCH = 40.0
"""Difference of criteria that leads from a previous choice to a richer one."""


@dataclass(frozen=True)
class Standing:
    """A rung against the others, over all scans.

    `criterion` is a sum, `spread` a mean, `highlight` the largest: infinite without lobes, and not
    used where a rung explains the data.
    """

    candidate: Candidate
    order: int
    parameters: int
    criterion: float
    spread: float
    determined: bool
    highlight: float


@dataclass(frozen=True)
class Verdict:
    """Which rung is kept, and why the others are not."""

    kept: Standing
    rejected: dict[Candidate, str]
    standings: Sequence[Standing]


class Comparison:
    """The rule, over rungs in the order of their parameters."""

    def __init__(self, standings: Sequence[Standing], explained: bool, price: float) -> None:
        self.standings = sorted(
            standings, key=lambda s: (s.parameters, 0.0 if explained else s.criterion, s.order)
        )
        self.explained, self._price = explained, price

    def verdict(self, previous: Candidate | None) -> Verdict:
        """Apply the rule."""
        rejected: dict[Candidate, str] = {}
        allowed = self._allowed()
        kept: Standing | None = None
        for index, standing in enumerate(allowed):
            why = self._against(standing, allowed[:index], allowed[index + 1 :])
            if not why:
                kept = standing
                break
            rejected[standing.candidate] = why
        if kept is None:
            kept = min(allowed, key=lambda s: (not s.determined, s.criterion))
        before = next((s for s in allowed if s.candidate == previous), None)
        if before is not None and before is not kept:
            why = self._stays(before, kept)
            if why:
                rejected[kept.candidate] = why
                rejected.pop(before.candidate, None)
                kept = before
        for standing in self.standings:
            if standing is kept:
                continue
            simpler = self.standings.index(standing) < self.standings.index(kept)
            if simpler and not self._no_highlight(standing) and self._decides(kept, standing):
                rejected[standing.candidate] = f"the kept one is {self._better_by(kept, standing)}"
            elif standing.candidate not in rejected:
                rejected[standing.candidate] = self._no_better(standing, kept)
        return Verdict(kept, rejected, self.standings)

    def further(self, kept: Standing) -> Standing:
        """Return the rung with the least error, if that is a hint of what matters; else the kept.

        Where none explains the data, a quarter of `MATTERS` is a hint: two steps may matter
        together where neither does. A lobe without a highlight may be one of two steps to a rung
        that explains the data.
        """
        least = min(self.standings, key=lambda s: s.spread)
        if self.explained or self._gain(least, kept) >= 0.25 * MATTERS:
            return least
        return kept

    def _allowed(self) -> Sequence[Standing]:
        return [s for s in self.standings if not self._no_highlight(s)] or self.standings

    def _no_highlight(self, standing: Standing) -> str:
        """Why a rung's lobes may not be kept, or nothing."""
        if self.explained:
            return ""
        if self._broad(standing):
            return (
                f"no lobe is a highlight: diffuse parts can make all but {standing.highlight:.0%} "
                f"of it ({HIGHLIGHT:.0%} needed where noise does not explain the data)"
            )
        for other in self.standings[: self.standings.index(standing)]:
            if self._broad(other) and not self._decides(standing, other):
                return f"its highlight is hardly better than none: {other.candidate.label}"
        return ""

    def _broad(self, standing: Standing) -> bool:
        """Whether lobes are without a highlight, and may be an error of a diffuse part."""
        diffuse = [s for s in self.standings if math.isinf(s.highlight)]
        return standing.highlight < HIGHLIGHT and any(
            self._gain(standing, other) < DOMINANT for other in diffuse
        )

    def _gain(self, rich: Standing, simple: Standing) -> float:
        if not simple.spread > 0:
            return 0.0
        return 1.0 - math.sqrt(rich.spread / simple.spread)

    def _beats(self, rich: Standing, simple: Standing, *, by: float, matters: float) -> bool:
        """Whether a rung is better by so much, twice so where it is undetermined."""
        factor = 1.0 if rich.determined else 2.0
        return simple.criterion - rich.criterion >= by * factor and (
            self.explained or self._gain(rich, simple) >= matters * factor
        )

    def _decides(self, rich: Standing, simple: Standing) -> bool:
        """Whether a rung beats one that is not richer."""
        return self._beats(rich, simple, by=DECISIVE, matters=MATTERS)

    def _against(
        self, one: Standing, simpler: Sequence[Standing], richer: Sequence[Standing]
    ) -> str:
        """Why a rung is not to be kept, or nothing."""
        beaten = [r for r in richer if self._decides(r, one)]
        if beaten:
            best = min(beaten, key=lambda s: s.criterion)
            return f"{best.candidate.label} is {self._better_by(best, one)}"
        lower = [s for s in simpler if s.criterion <= one.criterion]
        if lower:
            return f"no better than {lower[0].candidate.label}"
        if not one.determined:
            near = [s for s in simpler if not self._decides(one, s)]
            if near:
                return f"undetermined, and hardly better than {near[0].candidate.label}"
        return ""

    def _stays(self, before: Standing, new: Standing) -> str:
        """Why the previous rung stays, or nothing."""
        if new.parameters >= before.parameters:
            if self._beats(new, before, by=SWITCH, matters=2 * MATTERS):
                return ""
            needed = f"{SWITCH:g}" if self.explained else f"{SWITCH:g} and {2 * MATTERS:.0%}"
            return (
                f"{self._better_by(new, before)} than the previous {before.candidate.label}: "
                f"less than the {needed} for a change"
            )
        price = (before.parameters - new.parameters) * self._price
        worth = new.criterion - before.criterion > -0.5 * price
        if not worth or (not self.explained and self._gain(before, new) < 0.5 * MATTERS):
            return ""
        return f"not clear enough against the previous {before.candidate.label}"

    def _no_better(self, one: Standing, kept: Standing) -> str:
        no_highlight = self._no_highlight(one)
        if no_highlight:
            return no_highlight
        undetermined = "" if one.determined else "undetermined, and "
        if one.criterion >= kept.criterion:
            worse = one.criterion - kept.criterion
            return f"{undetermined}criterion higher by {worse:.1f} than {kept.candidate.label}'s"
        twice = 1 if one.determined else 2
        needed = f"{DECISIVE * twice:g}"
        if not self.explained:
            needed += f" and {MATTERS * twice:.0%}"
        better = self._better_by(one, kept)
        return f"{undetermined}only {better} than {kept.candidate.label} ({needed} needed)"

    def _better_by(self, rich: Standing, simple: Standing) -> str:
        lower = f"better by {simple.criterion - rich.criterion:.1f} in the criterion"
        if self.explained:
            return lower
        return f"{lower} and {self._gain(rich, simple):.0%} in error"
