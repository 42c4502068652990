"""Pure: what `acsard log report` shows. A recording in, the text of one HTML file out.

`course` takes step after step and keeps what is to be drawn, thinned by `thinning` as it comes, so
that a day takes no more room than a minute; `line` is what it keeps of the serial line and of the
loop, `commanders` of who sent commands. `account` says it in words, `path` and `figures` make
pictures of it with what `drawing` has, `page` puts all into a file, `look` has how that looks. The
library's own code comes as an argument; what strangers wrote (names, sentences) passes
`page.escaped` or `drawing.label`, whatever it says.
"""
