# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Benchmarks: run by hand, never part of the tests."""
