"""In which order nodes are stopped: light off and arm still first, the database last.

It follows from the graph alone: who commands or moves the light (gives ``/scan/command`` or
``/arm/state``) goes first, then everybody after those whose lossless messages they read, and last
the simulated world with the controller's twin, which the arm needs to the end. For what a database
(gives ``/scan/stored``) sends back of what it holds, nobody waits: it is stored already. Who only
listens, as a recorder does, goes after everybody that it hears, but for the world.
"""

from __future__ import annotations

from tvbrdf_messages.run_directory import Graph
from tvbrdf_messages.topics import LOSSLESS, find_topic

_FIRST = {"/scan/command", "/arm/state"}
_STORED = "/scan/stored"
_OF_EVERYBODY = {"/diagnostics", "/log"}


def stop_stages(graph: Graph) -> tuple[tuple[str, ...], ...]:
    """Return the names of the nodes in groups, in the order in which the groups are stopped."""
    nodes = [p for p in graph.participants if p.node]
    first = {p.name for p in nodes if _FIRST & set(p.gives)}
    world = {
        p.name
        for p in nodes
        if p.name not in first and any(t.startswith("/sim/") for t in (*p.takes, *p.gives))
    }
    stores = {p.name for p in nodes if _STORED in p.gives}
    listeners = {p.name for p in nodes if set(p.gives) <= _OF_EVERYBODY} - world
    sources = {
        p.name: {
            publisher
            for topic in p.takes
            if p.name in listeners or find_topic(topic).quality == LOSSLESS
            for publisher in graph.publishers(topic)
            if publisher != p.name and (p.name in listeners or publisher not in stores)
        }
        for p in nodes
    }
    depths: dict[str, int] = {}

    def depth(name: str, above: tuple[str, ...]) -> int:
        if name in first:
            return 0
        if name not in depths:
            before = sources.get(name, set()) - {name, *above}
            depths[name] = 1 + max((depth(source, (*above, name)) for source in before), default=0)
        return depths[name]

    stage = {p.name: len(nodes) + 1 if p.name in world else depth(p.name, ()) for p in nodes}
    return tuple(
        tuple(name for name in stage if stage[name] == number)
        for number in sorted(set(stage.values()))
    )
