"""Attacks of strangers, such as tenants, neighbours, and a monitor or a standby that others control. Each was possible once.

The table leads from the findings of the security review (issue 21) to their tests. A test is here if it needs an API server or the
network of a cluster. The others are in ``tests/unit``, and what has to be measured is in ``bench``.

=======  ===========================================  ==================================================================================
finding  attack                                       tests
=======  ===========================================  ==================================================================================
1        a deeply nested object ends the operator     strangers/test_objects.py; tests/unit/api/test_nesting.py,
                                                      tests/unit/kube/test_decoding.py, tests/unit/kube/test_deeply_nested_objects.py,
                                                      tests/unit/controller/test_deeply_nested_objects.py,
                                                      tests/unit/monitor/observe/test_unreadable_objects.py
2        costly trees end the operator                strangers/test_objects.py; tests/unit/controller/test_tree_judge.py,
                                                      tests/unit/process/test_tree_checker.py, tests/unit/trees/test_tree_check.py,
                                                      tests/unit/process/test_loop_turns.py
3        an author uses rights of the operator        strangers/test_authors.py, strangers/test_templates.py
4        a monitor opens its gate for others          strangers/test_gates.py, strangers/test_mux_gates.py,
                                                      strangers/test_pods.py; tests/unit/kube/test_gates.py
5        pods reach agents, monitors and metrics      strangers/test_network.py; tests/unit/controller/test_control_plane_policies.py
5        a pod passes for an instance or a monitor    strangers/test_new_pods.py, strangers/test_controllers.py
5        floods of connections and datagrams          tests/unit/agent/test_strangers.py, tests/unit/process/test_source_queues.py,
                                                      tests/unit/process/test_http_pages.py, tests/unit/kube/test_probe_floods.py;
                                                      bench/flood
5        forged test packets                          tests/unit/kube/test_probe_authentication.py
5        use of all memory of a node                  tests/unit/controller/test_memory_limits.py
6        relayed proofs, changed commands             tests/unit/agent/test_authentication.py, tests/unit/api/test_session_keys.py,
                                                      tests/unit/controller/test_agent_protocol.py
7        instances reach further than the robot       strangers/test_network.py; tests/unit/kube/test_gates.py
8        an application changes its agent's memory    tests/unit/agent/test_shared_volume.py, tests/unit/controller/test_agent_volumes.py
9        one tenant's operator reads all namespaces   tests/cluster/test_named_namespaces.py; charts/understudy/tests/rbac_test.yaml
10       control characters in texts of others        tests/unit/cli/test_hostile_text.py, tests/unit/api/test_plain_text.py
10       numbers with thousands of digits             tests/unit/trees/test_hostile_values.py
10       packages and images that were exchanged      tests/unit/test_constraints.py, tests/unit/test_release.py
10       import of a module that a user names         tests/unit/ros/test_interface_types.py
11       (the threat model)                           tests/unit/docs/test_pages.py: its links
all      generated objects and texts                  tests/unit/bench/test_fuzz.py; bench/fuzz
all      rights that an account does not need         tests/cluster/test_rights.py, tests/cluster/test_restricted.py
=======  ===========================================  ==================================================================================
"""
