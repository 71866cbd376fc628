"""The bus: ZeroMQ between processes, or the same contract inside one."""

from .inprocess import InProcessBus, InProcessPort
from .port import Port, PortEvent
from .zmq_port import ZmqPort

__all__ = ["InProcessBus", "InProcessPort", "Port", "PortEvent", "ZmqPort"]
