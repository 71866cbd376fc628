"""When the arm's node carries out a command, and how long that may take: pure rules."""

from __future__ import annotations

from tvbrdf_messages.messages import ScanCommand

from .driver import ArmLimits, ArmReading

MOTIONS = ("home", "prepare", "sweep", "jog")
NOT_OURS = ("end_sweep", "dark", "still")
"""Actions that concern cameras only."""


def refuse_command(
    command: ScanCommand, state: ArmReading | None, limits: ArmLimits, current: ScanCommand | None
) -> str:
    """Return why a command can't be carried out now; empty if it can.

    Parameters
    ----------
    command
        The command, already known to be in time and from the right sequencer.
    state
        Where the arm was last; None before its first report.
    limits
        Within what it may move.
    current
        The motion under way, if there is one.
    """
    action = command.action
    if action not in (*MOTIONS, "lamp"):
        return f"unknown action {action!r}"
    if action == "lamp":
        return _refuse_state(state, action) if command.lamp else ""
    reason = _refuse_state(state, action)
    if not reason and current is not None:
        reason = f"busy with {current.action} (command {current.command_id})"
    if not reason and action == "jog":
        reason = limits.refuse_angle(command.to_deg)
    elif not reason and action != "home":
        reason = limits.refuse_sweep(command.from_deg, command.to_deg, command.duration_s)
    return reason


def _refuse_state(state: ArmReading | None, action: str) -> str:
    if state is None:
        return ""  # the controller itself refuses what is not safe
    if state.emergency_stop:
        return "the emergency stop is pressed; release it, then home"
    if action in ("home", "lamp"):
        return ""
    if state.fault:
        return f"the arm has a fault ({state.fault}); clear its way, then home"
    return "" if state.homed else "the arm is not homed; home it first"


def time_limit_s(command: ScanCommand, limits: ArmLimits) -> float:
    """Return after how long a motion counts as never ending.

    Three times the longest way it can have, and half a minute: in simulation the run's clock may
    be ahead of what has been read.
    """
    across = (limits.max_angle_deg - limits.min_angle_deg) / limits.max_speed_deg_s
    ramps = limits.max_speed_deg_s / limits.acceleration_deg_s2
    sweep_s = command.duration_s if command.action == "sweep" else 0.0
    return 3.0 * (across + 2.0 * ramps + sweep_s) + 30.0
