"""What a headset received, as objects for lines of JSON. Pure."""

from __future__ import annotations

import argparse
import base64
from typing import Any

import msgspec

from macs_zenoh.errors import WireError
from macs_zenoh.protocol.keyexpr import type_name
from macs_zenoh.typed import Types, request_of

from .nodes import Incoming, ServiceRequest
from .verbs import MAX_BYTES


def shown_topic(types: Types, args: argparse.Namespace, message: Incoming) -> dict[str, Any]:
    """A topic's message: its fields, or its size where they are not wanted or cannot be read."""
    line: dict[str, Any] = {"topic": args.topic, "from": message.sender_id}
    if args.raw:
        return {**line, "bytes": len(message.data)}
    limit = None if args.full else MAX_BYTES
    try:
        return {**line, "message": types.deserialize(args.type, message.data, max_bytes=limit)}
    except WireError as error:
        return {**line, "bytes": len(message.data), "error": str(error)}


def shown_request(types: Types, args: argparse.Namespace, request: ServiceRequest) -> dict[str, Any]:
    """A request to a service that the headset runs."""
    line: dict[str, Any] = {"service": args.topic, "from": request.robot}
    try:
        return {**line, "request": types.deserialize(request_of(args.type), request.data)}
    except WireError as error:
        return {**line, "bytes": len(request.data), "error": str(error)}


def shown_message(message: Incoming, *, full: bool) -> dict[str, Any]:
    """A message that belongs to no node; long data only when it is wanted in full."""
    sender = None
    if message.sender_type is not None:
        sender = {"type": type_name(message.sender_type), "id": message.sender_id}
    line: dict[str, Any] = {"from": sender, "manager": message.metadata.message_manager, "bytes": len(message.data)}
    if message.metadata.request_id:
        line["request_id"] = message.metadata.request_id
    if message.metadata.node_name:
        line["node"] = message.metadata.node_name
    if len(message.data) > MAX_BYTES and not full:
        return line
    try:
        return {**line, "text": message.data.decode()}
    except UnicodeDecodeError:
        return {**line, "base64": base64.b64encode(message.data).decode("ascii")}


def json_or_text(data: bytes) -> Any:
    """What an answer says, whether it is JSON or not."""
    try:
        return msgspec.json.decode(data)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return data.decode(errors="replace")
