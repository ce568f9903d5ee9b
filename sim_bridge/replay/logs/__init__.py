"""Flight logs as streams of samples: MAVLink telemetry logs, ArduPilot dataflash logs, PX4 ULog.

`open_log` is the door; `sim_bridge.replay.logs.events` says what comes out.
"""

from sim_bridge.replay.logs.opening import open_log

__all__ = ["open_log"]
