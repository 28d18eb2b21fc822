"""The vocabulary of what can vary, and the ranges of each environment: `simreal.randomizers.<name>`."""

if __name__ != "simreal.randomizers":
    raise ImportError(
        "the folder 'randomizers' of simreal is not a package of its own: "
        "write 'import simreal.randomizers' instead"
    )
