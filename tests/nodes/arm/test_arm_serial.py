"""The serial driver: what it opens, what it refuses, and what it does when lines get lost."""

from __future__ import annotations

import contextlib
import os
import pty
import select
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import serial
import serial.rfc2217

from tvbrdf_messages.clock import SystemClock
from tvbrdf_nodes.arm.protocol import Answer, Event, Request, encode
from tvbrdf_nodes.arm.serial_arm import SerialArm
from tvbrdf_nodes.arm.serial_line import SerialLine, byte_time_ns
from tvbrdf_nodes.arm.serial_motions import Ended, MotionTable
from tvbrdf_nodes.arm.serial_parameters import SerialArmParameters
from tvbrdf_nodes.arm.serial_requests import PendingRequests
from tvbrdf_nodes.arm.serial_ticks import TickCounter
from tvbrdf_nodes.core.device import DeviceError, DriverContext
from tvbrdf_nodes.core.parameters import ParameterError, build

Make = Callable[..., Any]
LIMIT_S = 20.0


@pytest.fixture
def make_arm(tmp_path: Path) -> Iterator[Callable[..., SerialArm]]:
    """Return a function that makes a driver on its own; all are closed at the end."""
    made: list[SerialArm] = []

    def no_link() -> Any:
        raise AssertionError("a real driver opens no link")

    def make(port: str, **parameters: Any) -> SerialArm:
        context = DriverContext("arm", SystemClock(), None, tmp_path, no_link)  # type: ignore[arg-type]
        made.append(SerialArm(SerialArmParameters(port=port, **parameters), context))
        return made[-1]

    yield make
    for arm in made:
        arm.close()


def read_until_error(arm: SerialArm) -> str:
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline:
        select.select(arm.waitables(), [], [], 0.01)
        try:
            arm.read()
        except DeviceError as error:
            return str(error)
    raise AssertionError(f"no error within {LIMIT_S} s")


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    """Return a pseudo-terminal's master and the name of its slave."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    os.close(slave)
    with contextlib.suppress(OSError):
        os.close(master)


# -- opening


def test_absent_port(make_arm: Callable[..., SerialArm], tmp_path: Path) -> None:
    port = str(tmp_path / "ttyUSB7")
    arm = make_arm(port, connect_timeout_s=0.3)
    arm.open()
    text = read_until_error(arm)
    assert text.startswith(f"{port}: can't open the arm's port")
    assert "parameter 'port'" in text


def test_port_that_appears_late(make_arm_rig: Make) -> None:
    rig = make_arm_rig()
    rig.start("arm")
    rig.pace_s = 0.005
    for _ in range(5):
        rig.step()
    rig.world.publish("/sim/scene", rig.scene, stamp_ns=0)
    rig.start("arm_controller")
    rig._grant()
    rig.homed()


def test_port_in_use(make_arm_rig: Make, make_arm: Callable[..., SerialArm]) -> None:
    rig = make_arm_rig().start_all()
    rig.run(rig.states)
    arm = make_arm(str(rig.directory / "arm_controller.tty"), connect_timeout_s=0.2)
    arm.open()
    assert "exclusively lock port" in read_until_error(arm)


@pytest.mark.parametrize("port", ["socket://127.0.0.1:{}", "nonsense://there"])
def test_address_where_nobody_is(make_arm: Callable[..., SerialArm], port: str) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = port.format(free.getsockname()[1])
    arm = make_arm(port)
    with pytest.raises(DeviceError, match="can't open the arm's port") as caught:
        arm.open()
    assert str(caught.value).startswith(port)


def test_nobody_answers(make_arm: Callable[..., SerialArm], terminal: tuple[int, str]) -> None:
    arm = make_arm(terminal[1], connect_timeout_s=0.3, answer_timeout_s=0.05)
    arm.open()
    assert "no arm controller answers and nothing came" in read_until_error(arm)


def test_something_else_answers(
    make_arm: Callable[..., SerialArm], terminal: tuple[int, str]
) -> None:
    arm = make_arm(terminal[1], connect_timeout_s=0.3, answer_timeout_s=0.05)
    arm.open()
    os.write(terminal[0], b"\x80\xffERROR\r\nOK\r\n")
    assert "2 unreadable lines came: is baud_rate right?" in read_until_error(arm)


def test_no_line_monitor(make_arm: Callable[..., SerialArm], terminal: tuple[int, str]) -> None:
    arm = make_arm(terminal[1], connect_timeout_s=0.3, arrival_stamps="line")
    arm.open()
    os.write(terminal[0], encode(Answer(1)))
    assert "set arrival_stamps: host" in read_until_error(arm)


def test_gone_before_it_answered(
    make_arm: Callable[..., SerialArm], terminal: tuple[int, str]
) -> None:
    arm = make_arm(terminal[1])
    arm.open()
    os.close(terminal[0])
    assert "port is gone (unplugged?)" in read_until_error(arm)
    assert not arm.halt(0.1)


# -- what is refused


def test_controller_without_a_watchdog(make_arm_rig: Make) -> None:
    rig = make_arm_rig(controller={"keepalive_watchdog": False}).start_all()
    with pytest.raises(DeviceError, match=r"does not stop by itself .* unattended: false"):
        rig.run(lambda: False)


def test_controller_with_a_slow_watchdog(make_arm_rig: Make) -> None:
    rig = make_arm_rig(controller={"watchdog_s": 2.0}).start_all()
    with pytest.raises(DeviceError, match="watchdog 2 s"):
        rig.run(lambda: False)


def test_attended_controller_needs_no_watchdog(make_arm_rig: Make) -> None:
    rig = make_arm_rig(controller={"keepalive_watchdog": False}, arm={"unattended": False})
    rig.start_all().homed()


def test_limits_are_the_tighter_ones(make_arm_rig: Make) -> None:
    arm = {"min_angle_deg": -95.0, "max_speed_deg_s": 20.0, "max_acceleration_deg_s2": 30.0}
    rig = make_arm_rig(arm=arm, controller={"max_angle_deg": 91.0}).start_all().homed()
    limits = rig.runners["arm"].node._driver.limits
    assert (limits.min_angle_deg, limits.max_angle_deg) == (-95.0, 91.0)
    assert (limits.max_speed_deg_s, limits.acceleration_deg_s2) == (20.0, 30.0)
    twin = rig.runners["arm_controller"].node._firmware
    assert twin.arm.limits == limits  # the controller itself keeps them, too


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"port": ""}, "port is empty"),
        ({"arrival_stamps": "later"}, "expected host or line"),
        ({"keepalive_s": 0.4}, "expected up to 0.25"),
        ({"min_angle_deg": 120.0}, "must be below"),
        ({"attempts": 0}, "attempts is 0"),
        ({"baud": 9600}, "did you mean 'baud_rate'"),
    ],
)
def test_wrong_parameters(given: dict[str, Any], text: str) -> None:
    with pytest.raises(ParameterError) as caught:
        build(SerialArmParameters, {"port": "/dev/ttyUSB0", **given})
    assert text in str(caught.value)


# -- other ways to the controller


class Bridge:
    """Serves a controller's port over TCP, as a terminal server does."""

    def __init__(self, port: str, serve: Callable[[socket.socket, str], None]) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._thread = threading.Thread(target=self._run, args=(serve, port))
        self._thread.start()
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"

    def _run(self, serve: Callable[[socket.socket, str], None], port: str) -> None:
        connection, _ = self._listener.accept()
        with connection:
            serve(connection, port)

    def close(self) -> None:
        self._thread.join(LIMIT_S)
        assert not self._thread.is_alive()
        self._listener.close()


def serve_raw(connection: socket.socket, port: str) -> None:
    with serial.Serial(port, timeout=0) as device:
        while True:
            ready, _, _ = select.select([connection, device], [], [], LIMIT_S)
            if device in ready:
                connection.sendall(device.read(4096))
            if connection in ready:
                data = connection.recv(4096)
                if not data:
                    return
                device.write(data)


class _NoModemLines(serial.Serial):  # type: ignore[misc]
    """A pseudo-terminal has no modem lines to ask for."""

    cts = dsr = ri = cd = False

    def _update_rts_state(self) -> None: ...

    def _update_dtr_state(self) -> None: ...


def serve_rfc2217(connection: socket.socket, port: str) -> None:
    with _NoModemLines(port, timeout=0) as device, connection.makefile("wb", 0) as out:
        manager = serial.rfc2217.PortManager(device, out)
        while True:
            ready, _, _ = select.select([connection, device], [], [], LIMIT_S)
            if device in ready:
                out.write(b"".join(manager.escape(device.read(4096))))
            if connection in ready:
                data = connection.recv(4096)
                if not data:
                    return
                device.write(b"".join(manager.filter(data)))


@pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")  # pyserial 3.5's own
@pytest.mark.parametrize(("scheme", "serve"), [("socket", serve_raw), ("rfc2217", serve_rfc2217)])
def test_over_the_network(
    make_arm_rig: Make, scheme: str, serve: Callable[[socket.socket, str], None]
) -> None:
    rig = make_arm_rig(arm={"port": ""})
    rig.world.publish("/sim/scene", rig.scene, stamp_ns=0)
    rig.start("arm_controller")
    rig._grant()
    bridge = Bridge(str(rig.directory / "arm_controller.tty"), serve)
    rig.graph.find("arm").parameters["driver_parameters"]["port"] = f"{scheme}://{bridge.address}"
    rig.pace_s = 0.005  # or simulated time is far ahead of what is still on its way
    try:
        rig.start("arm")
        rig.homed()
        result = rig.do("sweep", from_deg=-30.0, to_deg=30.0, duration_s=4.0)
        assert result.state == "done"
        speeds = [s.speed_deg_s for _, s in rig.states() if s.moving and abs(s.angle_deg) < 30]
        assert speeds.count(15.0) >= 199
    finally:
        with rig.twin_running():
            arm = rig.runners.pop("arm")
            arm.put(arm.node.stop())
        bridge.close()


def test_network_connection_that_ends(make_arm: Callable[..., SerialArm]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        arm = make_arm(f"socket://127.0.0.1:{listener.getsockname()[1]}")
        arm.open()
        listener.accept()[0].close()
        assert "port is gone (unplugged?): " in read_until_error(arm)


def test_port_that_takes_no_bytes() -> None:
    master, slave = pty.openpty()
    tty.setraw(slave)
    line = SerialLine(os.ttyname(slave), 115200, SystemClock())
    try:
        line.write(bytes(1000))
        assert os.read(master, 2000) == bytes(1000)
        with pytest.raises(DeviceError, match=r"takes no bytes for 0\.5 s; check the cable"):
            line.write(bytes(1_000_000))
    finally:
        line.close()
        os.close(master)
        os.close(slave)


# -- its parts


def test_repeated_requests_keep_their_number() -> None:
    sent: list[bytes] = []
    requests = PendingRequests(sent.append, SystemClock(), 0.0, 3)
    number = requests.ask("MOVE", 12.5)
    assert requests.expire() == []
    assert requests.expire() == []
    (given_up,) = requests.expire()
    assert given_up.request == Request(number, "MOVE", (12.5,))
    assert sent == [given_up.line] * 3
    assert requests.take(number) is None
    once = requests.ask("ALIVE", once=True)
    assert [p.request.request_id for p in requests.expire()] == [once]


def test_dropped_requests_are_not_repeated() -> None:
    sent: list[bytes] = []
    requests = PendingRequests(sent.append, SystemClock(), 0.0, 3)
    requests.ask("LAMP", 1)
    requests.ask("STOP")
    assert [p.request.verb for p in requests.drop("LAMP", "MOVE")] == ["LAMP"]
    requests.expire()
    assert [line.split(b"*")[0].split()[2] for line in sent] == [b"LAMP", b"STOP", b"STOP"]


def status(flags: str, last: int, outcome: str) -> Answer:
    return Answer(1, (("flags", flags), ("last", str(last)), ("outcome", outcome)))


def test_motions_whose_end_was_not_told() -> None:
    table = MotionTable()
    table.accept(5, "SWEEP")
    assert [table.missed_end(moving) for moving in (True, False, False, False)][-1]
    assert table.take_status(status("MH", 5, "running")) == []
    assert table.take_status(status("H", 5, "done")) == [Ended(5, "SWEEP", "")]
    assert table.take_event(Event(5, 0, "DONE")) == []
    table.accept(6, "MOVE")
    table.accept(7, "STOP")
    found = table.take_status(status("H", 6, "stopped"))
    assert found == [Ended(6, "MOVE", "it was stopped"), Ended(7, "STOP", "")]
    table.accept(8, "MOVE")
    ((_, _, reason),) = table.take_status(status("-", 0, "-"))
    assert "does not remember" in reason
    assert not table.missed_end(False)


@pytest.mark.parametrize("bits", [16, 32, 64])
def test_ticks_unwrap(bits: int) -> None:
    counter = TickCounter(bits)
    true = [
        3,
        2**bits // 3,
        2 * 2**bits // 3,
        2**bits - 1,
        2**bits - 2,
        2**bits + 5,
        4 * 2**bits // 3,
    ]
    assert [counter.unwrap(t % 2**bits) for t in true] == true


def test_time_on_the_wire(tmp_path: Path) -> None:
    assert byte_time_ns("/dev/ttyUSB0", 115200) == pytest.approx(86805.6, abs=0.1)
    assert byte_time_ns("socket://there:1", 115200) == 0.0
    link = tmp_path / "arm.tty"
    link.symlink_to("/dev/pts/1")
    assert byte_time_ns(str(link), 115200) == 0.0
