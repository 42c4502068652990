"""Shell package that owns the serial port: raw and locked, without a queue, with a STOP at the
end."""
