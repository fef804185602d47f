"""The two ways in which the package speaks of trouble: one line that says what is wrong, where, and what to do."""


class PrtError(ValueError):
    """Input or a file that cannot be used; the message is one line for the user, never a traceback's worth."""


class PrtWarning(UserWarning):
    """Something was handled on the user's behalf (negative pixels clamped, a mesh facing inwards)."""


class NotDiffuseWarning(PrtWarning):
    """A surface is not diffuse, and a matrix without terms takes it for diffuse."""


class LampWarning(PrtWarning):
    """A shape shines, and a matrix of distant light has none of it."""
