# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""How nodes publish and subscribe: reliably or not, and what is said when that does not fit.

Each QoS can be changed by the parameters ``qos_overrides.<topic>.<publisher|subscription>.*``.
"""

from __future__ import annotations

from collections.abc import Callable

from rclpy.event_handler import QoSRequestedIncompatibleQoSInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind
from rclpy.qos_overriding_options import QoSOverridingOptions, QoSPolicyKind
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo


def advertise(node: Node, kind: type, topic: str, depth: int) -> Publisher:
    """Publish a topic, reliably: whoever listens then has what he asks for."""
    return node.create_publisher(
        kind, topic, _qos(depth, True), qos_overriding_options=_overridable()
    )


def hear(
    node: Node,
    kind: type,
    topic: str,
    take: Callable[..., None],
    depth: int,
    *,
    reliable: bool = True,
    raw: bool = False,
    explain: Callable[[str], str] | None = None,
) -> Subscription:
    """Subscribe to a topic; log why a publisher cannot be heard.

    Parameters
    ----------
    node : Node
    kind : type
        Of the messages.
    topic : str
    take : callable
        Takes a message, and what else its signature asks for, as rclpy has it.
    depth : int
        Messages that may wait to be taken.
    reliable : bool
        Lose none; else best effort, which hears every sender.
    raw : bool
        Take the serialized bytes.
    explain : callable, optional
        Takes the name of the policy by which a publisher does not fit; returns what to say.
    """
    name = node.resolve_topic_name(topic)
    explain = explain or (lambda policy: _remedy(name, policy.lower()))

    def warn(event: QoSRequestedIncompatibleQoSInfo) -> None:
        node.get_logger().warning(explain(qos_policy_name_from_kind(event.last_policy_kind)))

    return node.create_subscription(
        kind,
        topic,
        take,
        _qos(depth, reliable),
        raw=raw,
        event_callbacks=SubscriptionEventCallbacks(incompatible_qos=warn),
        qos_overriding_options=_overridable(),
    )


def hear_camera_info(node: Node, take: Callable[[CameraInfo], None]) -> Subscription:
    """Subscribe to ``camera_info``, best effort: this hears every sender."""
    # Not for one that is kept for those who come later: asking for it makes all other senders
    # warn of a subscriber that they cannot serve.
    return hear(node, CameraInfo, "camera_info", take, 10, reliable=False)


def _qos(depth: int, reliable: bool) -> QoSProfile:
    """Each publisher or subscription needs its own: overrides change it."""
    kind = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(depth=depth, reliability=kind)


def _overridable() -> QoSOverridingOptions:
    kinds = QoSPolicyKind
    return QoSOverridingOptions((kinds.HISTORY, kinds.DEPTH, kinds.RELIABILITY, kinds.DURABILITY))


def _remedy(topic: str, policy: str) -> str:
    return (
        f"a publisher of {topic} cannot be heard, since it offers another {policy}: set"
        f" qos_overrides.{topic}.subscription.{policy} of this node to what it offers"
    )
