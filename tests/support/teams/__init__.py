"""Model of several users who change versioned datasets on two servers, and the means to compare servers with it.

`contents` describes content without ids and digests, `three_way` merges versions in a simple and slow way, `model` is
the expected state of both servers, and `operations`, `item_operations` and `transfers` are what users do. `hosts`
starts servers that can be killed between any two steps, and loses answers. `comparison` compares a server with the
model, and `machine` runs random programs.
"""
