"""One Ethernet segment between network namespaces that loses and delays frames, switched in this process.

Run as ``python -m tests.support.lossnet.segment NAMESPACE...`` by root, in existing namespaces: each gets
``radio0`` with the address 10.77.0.(i+1)/24. Says ``ready`` on stdout, then takes one line of JSON at a time on
stdin, the `LinkFaults` of every directed link from now on, and answers it with ``[frames, lost frames, bytes]`` so
far. Ends with the end of stdin; the devices vanish with it.

The kernel's own means (netem) are missing on many machines; a TAP device per namespace needs only ``/dev/net/tun``.
"""

from __future__ import annotations

import fcntl
import os
import select
import struct
import subprocess
import sys
import time

import msgspec

from transport.link.channel import Channel, ChannelSettings

DEVICE = "radio0"
MTU_BYTES = 1500
MAX_FRAME_BYTES = 65_536
BURST_FRAMES = 64
LONGEST_WAIT_S = 0.5
TUNSETIFF, IFF_TAP, IFF_NO_PI = 0x400454CA, 0x0002, 0x1000
MAC = bytes([2, 0, 0, 0, 0x77])
ADDRESS_BYTES = 6
SOLICITATIONS = 10
"""How often a node asks for a neighbour's hardware address before it gives up, as docs/links.md advises; the kernel's
three are all lost in one case of eight, and then it sends that neighbour nothing for seconds."""


def address(node: int) -> str:
    """The address of a node on the segment, counted from 0."""
    return f"10.77.0.{node + 1}"


def ip(*arguments: str) -> None:
    """iproute2; raises `subprocess.CalledProcessError`, its words on stderr."""
    subprocess.run(["ip", *arguments], check=True, stdout=subprocess.DEVNULL)


class Segment:
    """The switch: frames come from the nodes' devices, and go to where their destination address says."""

    def __init__(self, namespaces: list[str], seed: int) -> None:
        self._nodes = range(len(namespaces))
        self._seed = seed
        self._devices = [_tap(namespace, node) for node, namespace in enumerate(namespaces)]
        self._into = self._channels(ChannelSettings())
        self.frames = self.lost_before = self.bytes = 0

    def close(self) -> None:
        for device in self._devices:
            os.close(device)

    def set_faults(self, faults: ChannelSettings) -> None:
        """Of all links; what is under way in the old ones is lost."""
        self.lost_before = self.lost
        self._into = self._channels(faults)
        self._seed += 1

    @property
    def lost(self) -> int:
        """Frames lost so far."""
        return self.lost_before + sum(sum(channel.lost.values()) for channel in self._into)

    def devices(self) -> list[int]:
        return self._devices

    def take(self, node: int, now: float) -> None:
        """Frames that a node has sent."""
        for _ in range(BURST_FRAMES):
            try:
                frame = os.read(self._devices[node], MAX_FRAME_BYTES)
            except BlockingIOError:
                return
            for receiver in self._receivers(frame, node):
                self.frames += 1
                self.bytes += len(frame)
                self._into[receiver].offer(node, frame, now)

    def deliver(self, now: float) -> float:
        """Write what is due; the time until the next frame is, at most `LONGEST_WAIT_S`."""
        waits = [LONGEST_WAIT_S]
        for receiver, channel in enumerate(self._into):
            for _, frame in channel.due(now):
                try:
                    os.write(self._devices[receiver], frame)
                except OSError:
                    continue  # the receiver's queue is full: as on a radio, this frame is gone
            due_s = channel.next_due()
            waits += [] if due_s is None else [max(0.0, due_s - now)]
        return min(waits)

    def _receivers(self, frame: bytes, sender: int) -> list[int]:
        destination = frame[:ADDRESS_BYTES]
        if destination[0] & 1:  # broadcast and multicast
            return [node for node in self._nodes if node != sender]
        return [node for node in self._nodes if destination == _mac(node) and node != sender]

    def _channels(self, faults: ChannelSettings) -> list[Channel[bytes]]:
        return [
            Channel.seeded(faults, seed=self._seed, receiver=node, neighbours=[n for n in self._nodes if n != node])
            for node in self._nodes
        ]


def _mac(node: int) -> bytes:
    return MAC + bytes([node + 1])


def _tap(namespace: str, node: int) -> int:
    """A TAP device whose other end is in the namespace."""
    descriptor = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    name = f"fl{os.getpid()}n{node}"
    fcntl.ioctl(descriptor, TUNSETIFF, struct.pack("16sH", name.encode(), IFF_TAP | IFF_NO_PI))
    ip("link", "set", name, "netns", namespace, "name", DEVICE)
    mac = ":".join(f"{byte:02x}" for byte in _mac(node))
    ip("-n", namespace, "link", "set", DEVICE, "address", mac, "mtu", str(MTU_BYTES), "up")
    for kind in ("ucast_solicit", "mcast_solicit"):
        setting = f"/proc/sys/net/ipv4/neigh/{DEVICE}/{kind}"
        ip("netns", "exec", namespace, "sh", "-c", f"echo {SOLICITATIONS} > {setting}")
    ip("-n", namespace, "addr", "add", f"{address(node)}/24", "dev", DEVICE)
    return descriptor


def _say(line: bytes) -> None:
    sys.stdout.buffer.write(line + b"\n")
    sys.stdout.buffer.flush()


def serve(namespaces: list[str], seed: int = 1) -> None:
    """Switch until stdin ends."""
    segment = Segment(namespaces, seed)
    stdin = sys.stdin.fileno()
    poll = select.epoll()
    for descriptor in (stdin, *segment.devices()):
        poll.register(descriptor, select.EPOLLIN)
    node_of = {descriptor: node for node, descriptor in enumerate(segment.devices())}
    _say(b"ready")
    wait_s = LONGEST_WAIT_S
    try:
        while True:
            for descriptor, _ in poll.poll(wait_s):
                if descriptor == stdin:
                    if not (line := os.read(stdin, MAX_FRAME_BYTES)):
                        return
                    segment.set_faults(msgspec.json.decode(line, type=ChannelSettings))
                    _say(msgspec.json.encode([segment.frames, segment.lost, segment.bytes]))
                else:
                    segment.take(node_of[descriptor], time.monotonic())
            wait_s = segment.deliver(time.monotonic())
    finally:
        segment.close()


if __name__ == "__main__":
    serve(sys.argv[1:])
