"""Small nodes to start, link and break."""

from __future__ import annotations

from dataclasses import dataclass

from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import Mark, ScanMissing
from tvbrdf_nodes.core.node import Exit, Node, Outputs, Send, TopicUse

SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class TickerParameters:
    """How often, and how many."""

    period_s: float = 60.0
    ticks: int = 3
    then_fail: bool = False


class Ticker(Node[TickerParameters]):
    """Tells the time on ``/operator/mark``."""

    parameters_type = TickerParameters
    stopped = 0

    @classmethod
    def topics(cls, name: str, parameters: TickerParameters) -> TopicUse:
        return TopicUse(gives=("/operator/mark", "/diagnostics", "/log"))

    def start(self) -> Outputs:
        self._told = 0
        self.context.log.info("the ticker begins")
        self._again()
        return ()

    def _again(self) -> None:
        at_ns = self.context.clock.now_ns() + round(self.parameters.period_s * SECOND_NS)
        self.context.set_timer("tick", at_ns)

    def on_timer(self, name: str) -> Outputs:
        self._told += 1
        yield Send(topic="/operator/mark", message=Mark(text=f"tick {self._told}"))
        if self._told < self.parameters.ticks:
            self._again()
        elif self.parameters.then_fail:
            yield Exit(1, "the spring is broken")

    def stop(self) -> Outputs:
        type(self).stopped += 1
        return ()


class Counter(Node[TickerParameters]):
    """Answers each mark on ``/scan/missing``; breaks on the mark ``break``."""

    parameters_type = TickerParameters

    @classmethod
    def topics(cls, name: str, parameters: TickerParameters) -> TopicUse:
        return TopicUse(takes=("/operator/mark",), gives=("/scan/missing", "/log"))

    def handle(self, envelope: Envelope) -> Outputs:
        assert isinstance(envelope.message, Mark)
        if envelope.message.text == "break":
            raise ZeroDivisionError("as it was told")
        reason = f"{self.context.name} heard {envelope.message.text}"
        yield Send(
            topic="/scan/missing",
            message=ScanMissing(sample="s", scan=1, scan_time_s=0.0, reason=reason),
        )


class Breaks(Node[TickerParameters]):
    """Fails when it is stopped."""

    parameters_type = TickerParameters

    @classmethod
    def topics(cls, name: str, parameters: TickerParameters) -> TopicUse:
        return TopicUse(gives=("/log",))

    def stop(self) -> Outputs:
        raise OSError("the device is gone")
