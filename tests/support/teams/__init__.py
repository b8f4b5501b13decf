"""Model of several users who change versioned datasets on two servers, and comparisons of servers with this model.

`contents` describes content without ids and digests, and `three_way` merges versions in a simple and slow way. `model`
is the expected state of both servers; `operations`, `item_operations` and `transfers` are actions of users. `hosts`
starts servers that can be killed between any two steps, and connections that can lose answers. `comparison` compares a
server with the model, and `machine` runs random programs.
"""
