"""Counts the values of a msgpack message before any of them is made."""

# A value takes a byte on the wire and 64 in memory at most, if it is an empty map: shorter messages
# need no counting.
UNCOUNTED_BYTES = 1 << 16

_FIX_MAP, _FIX_ARRAY, _FIX_STR, _NIL = 0x80, 0x90, 0xA0, 0xC0
# Bytes of the length that follows a head, and those of the head's value besides that many.
_LENGTHS = {
    0xC4: (1, 0), 0xC5: (2, 0), 0xC6: (4, 0),  # bin
    0xC7: (1, 1), 0xC8: (2, 1), 0xC9: (4, 1),  # ext
    0xD9: (1, 0), 0xDA: (2, 0), 0xDB: (4, 0),  # str
}  # fmt: skip
_SIZES = {
    0xCA: 4, 0xCB: 8,  # float
    0xCC: 1, 0xCD: 2, 0xCE: 4, 0xCF: 8, 0xD0: 1, 0xD1: 2, 0xD2: 4, 0xD3: 8,  # int
    0xD4: 2, 0xD5: 3, 0xD6: 5, 0xD7: 9, 0xD8: 17,  # fixext
}  # fmt: skip
_CONTAINERS = {0xDC: (2, 1), 0xDD: (4, 1), 0xDE: (2, 2), 0xDF: (4, 2)}  # array, map


def has_too_many_values(payload: bytes, most: int) -> bool:
    """Whether there are more than so many: arrays, maps, their keys and all that they hold.

    Arrays and maps count as many as they announce, so that it takes as long as ``most`` do.
    """
    if len(payload) <= UNCOUNTED_BYTES:
        return False
    position, left, made = 0, 1, 0
    while left and position < len(payload):
        position, more = _next(payload, position)
        left, made = left + more - 1, made + 1
        if made + left > most:
            return True
    return False


def _next(payload: bytes, position: int) -> tuple[int, int]:
    """Pass a value over: where the next one begins, and how many values it holds."""
    head = payload[position]
    position += 1
    if _FIX_MAP <= head < _NIL:
        if head >= _FIX_STR:
            return position + (head & 31), 0
        return position, (head & 15) * (1 if head >= _FIX_ARRAY else 2)
    if head in _CONTAINERS:
        size, each = _CONTAINERS[head]
        return position + size, each * _number(payload, position, size)
    if head in _LENGTHS:
        size, more = _LENGTHS[head]
        return position + size + more + _number(payload, position, size), 0
    return position + _SIZES.get(head, 0), 0


def _number(payload: bytes, position: int, size: int) -> int:
    return int.from_bytes(payload[position : position + size], "big")
