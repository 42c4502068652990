"""Shell, with a pure core: the black box. What came into every step and what went out of it.

`steps` is what a recording says of a step, `batch` and `columns` make bytes of many, `replay` lives
it again, `merge` puts another configuration under a state, `story` tells it in sentences: all pure.
`state` makes bytes of a robot, `file` reads and writes MCAP, `again` lives one again, for who
compares and for who looks on, `ring` bounds a directory, `recorder` has the thread.
"""
