"""An own management message: a headset compares its clock with the gateway's (docs/managers.md)."""
