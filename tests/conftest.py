"""Settings for every test: the same examples on every run and on every machine, and no stop-watch."""

from __future__ import annotations

import os
import shutil
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, settings

if TYPE_CHECKING:
    from ipmsm_can.drive.node import DriveNode

settings.register_profile(
    "reproducible",
    derandomize=True,
    deadline=None,  # the first call of a kernel compiles it
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("reproducible")


@pytest.fixture(scope="module", params=["python", "c"])
def node_class(request: pytest.FixtureRequest) -> type[DriveNode]:
    """The simulated drive with frames of the package's own, and with those of the C library."""
    from ipmsm_can.drive.firmware import FirmwareNode
    from ipmsm_can.drive.node import DriveNode

    if request.param == "python":
        return DriveNode
    if not shutil.which("cc") and os.environ.get("CI") != "true":
        pytest.skip("no C compiler")
    return FirmwareNode
