"""The environments, one file each: `simreal.envs.<name>`."""

if __name__ != "simreal.envs":
    raise ImportError(
        "the folder 'envs' of simreal is not a package of its own: write 'import simreal.envs' instead"
    )
