"""MAVLink bytes cut at the ends of frames, none added and none lost.

A simulator on TCP sends a stream; the daemon opposite reads datagrams and takes each for a number of whole frames.
Sans-I/O.
"""

from __future__ import annotations

V1_MAGIC, V2_MAGIC = 0xFE, 0xFD
V1_OVERHEAD, V2_OVERHEAD, SIGNATURE_BYTES = 8, 12, 13
SIGNED = 0x01
V2_HEADER_BYTES = 10
MAX_FRAME_BYTES = V2_OVERHEAD + 255 + SIGNATURE_BYTES


def frame_length(data: bytes | bytearray, start: int) -> int | None:
    """Bytes of the frame whose magic byte is at ``start``; ``None`` while its header is incomplete."""
    if len(data) < start + 3:
        return None
    payload = data[start + 1]
    if data[start] == V1_MAGIC:
        return V1_OVERHEAD + payload
    return V2_OVERHEAD + payload + (SIGNATURE_BYTES if data[start + 2] & SIGNED else 0)


def message_id(chunk: bytes) -> int | None:
    """The message id of a chunk that is one frame; ``None`` for anything else."""
    if len(chunk) < V1_OVERHEAD or chunk[0] not in (V1_MAGIC, V2_MAGIC) or frame_length(chunk, 0) != len(chunk):
        return None
    return chunk[5] if chunk[0] == V1_MAGIC else int.from_bytes(chunk[7:V2_HEADER_BYTES], "little")


class FrameSplitter:
    """Cuts a stream, or datagram by datagram, into frames and the bytes between them."""

    def __init__(self) -> None:
        self._waiting = bytearray()

    @property
    def waiting(self) -> int:
        """Bytes of a frame that is not complete yet."""
        return len(self._waiting)

    def reset(self) -> bytes:
        """The connection was opened anew: what is left of the old one."""
        rest, self._waiting = bytes(self._waiting), bytearray()
        return rest

    def feed(self, data: bytes) -> list[bytes]:
        """The complete chunks in order: together all that was fed, but for an incomplete frame at the end."""
        self._waiting += data
        waiting, chunks, start = self._waiting, [], 0
        while start < len(waiting):
            if waiting[start] not in (V1_MAGIC, V2_MAGIC):
                end = _next_magic(waiting, start)
            else:
                length = frame_length(waiting, start)
                if length is None or start + length > len(waiting):
                    break
                end = start + length
            chunks.append(bytes(waiting[start:end]))
            start = end
        del waiting[:start]
        return chunks


def split_datagram(data: bytes) -> list[bytes]:
    """The frames of one datagram; its bytes are kept, whatever they are."""
    splitter = FrameSplitter()
    chunks, rest = splitter.feed(data), splitter.reset()
    return [*chunks, rest] if rest else chunks


def _next_magic(data: bytearray, start: int) -> int:
    found = [at for at in (data.find(V1_MAGIC, start), data.find(V2_MAGIC, start)) if at >= 0]
    return min(found, default=len(data))
