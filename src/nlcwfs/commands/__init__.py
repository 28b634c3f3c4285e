"""What the commands of `nlcwfs` do; `nlcwfs.cli` says how they are typed.

Each module is one command and is imported when it is typed: the help must not wait for JAX.
"""
