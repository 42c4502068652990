"""Pure: what comes in over the bus: samples -> commands, queries -> replies or requests."""
