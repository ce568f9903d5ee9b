"""One TOML file for the whole fleet, from text to checked tables, one way:

`documents` (files and options laid over each other, with the lines of `toml_lines`) -> `structs` (each setting by
itself, against the structs of `tables`) -> `checks` (what has to hold between settings) -> `reading` (all of it, and
the tables of other rooms). `faults` are what goes wrong on the way, `retired` the keys that are none any more.
"""
