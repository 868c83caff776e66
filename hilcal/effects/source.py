"""The file that a class is from, which messages to its author name."""


def source_of(kind: type) -> str:
    """Return the file that a class is defined in; its module where that is unknown."""
    for member in vars(kind).values():
        function = getattr(member, "fget", getattr(member, "__func__", member))
        if code := getattr(function, "__code__", None):
            return str(code.co_filename)
    return kind.__module__
