"""Tests that import this are skipped where the packages of the extra `middleware` are missing."""

import pytest

for name in ("rosbags", "mcap", "cyclonedds"):
    pytest.importorskip(name)
