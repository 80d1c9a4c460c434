"""A submission and how it is asked: loading, contract, process, sandbox, cost of its thinking."""
