# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Optical flow: how far each object moved between the previous frame and the current one.

Two Lucas-Kanade engines behind one interface, both of AAS 21-364: ``SparseLucasKanade``
(pyramidal, at points; the paper's OpenCV pipeline) and ``DenseLucasKanade`` (derivative, at every
pixel; its MATLAB pipeline).  Each takes two `FlowInput` and first guesses, and returns a `Flow`.
Third stage: it measures and judges how well, but does not know what is a star.
"""

from ofsat_ros.optical_flow.dense import DenseLucasKanade
from ofsat_ros.optical_flow.flow import Flow, FlowEngine, FlowInput
from ofsat_ros.optical_flow.sparse import SparseLucasKanade
from ofsat_ros.parameters import Parameters

__all__ = [
    "DenseLucasKanade",
    "Flow",
    "FlowEngine",
    "FlowInput",
    "SparseLucasKanade",
    "flow_engine",
]


def flow_engine(parameters: Parameters) -> FlowEngine:
    """Return the engine that `parameters.engine` names."""
    if parameters.engine == "sparse":
        return SparseLucasKanade(parameters)
    return DenseLucasKanade(parameters)
