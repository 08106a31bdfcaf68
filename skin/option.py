"""The name of an option: of a simulator, device, model, ..."""


def option_name(made: object) -> str:
    """Return the name of the option that an object, its class or its factory is: that of its module.

    ``skin.simulator.fem.PlatesAndBeams`` is the option ``fem``, as in ``simulator=fem``.
    """
    return made.__module__.rpartition(".")[2]
