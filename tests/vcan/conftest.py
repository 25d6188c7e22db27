"""Tests against a real SocketCAN interface vcan0; `tools/vcan/run COMMAND` provides one."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    present = Path("/sys/class/net/vcan0").exists()
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.vcan)
            if not present and os.environ.get("IPMSM_CAN_REQUIRE_VCAN") != "1":
                item.add_marker(pytest.mark.skip(reason="no vcan0 here; `tools/vcan/run` provides one"))


@pytest.fixture(autouse=True, scope="session")
def vcan0() -> str:
    """The interface's name; fails where it is demanded (IPMSM_CAN_REQUIRE_VCAN=1) and missing."""
    if not Path("/sys/class/net/vcan0").exists():
        pytest.fail("IPMSM_CAN_REQUIRE_VCAN=1, but there is no vcan0; run with `tools/vcan/run COMMAND`")
    return "vcan0"
