"""No room of the project is larger than its limit in `size_limits.csv`; limits only go down."""

import pytest

from tools import size


@pytest.mark.parametrize("room", size.rooms(), ids=lambda room: room.name)
def test_the_room_is_within_its_limit(room):
    assert 0 < room.size <= room.limit, f"{room.name}: {room.size} {room.unit}, at most {room.limit}; take away first"


def test_every_file_of_the_library_is_in_one_room():
    code = [room for room in size.rooms() if room.name.startswith("zsp_lite")]
    parts, whole = [room.size for room in code if room.name != "zsp_lite in all"], code[-1]
    assert whole.name == "zsp_lite in all" and sum(parts) == whole.size
