"""Attacks on a running site, with well-behaved neighbours beside them, and what must hold meanwhile.

::

    python -m tests.attack --list                         # every attack, one line each
    python -m tests.attack empty_lists_as_management      # one of them
    python -m tests.attack --section 3 --stops 100        # a section, with 100 stops pressed under each
    python -m tests.attack half_frames --way tls          # over TLS, or by WebSocket: --way web
    python -m tests.attack                                # all of them, and a table

It stays on loopback: attackers come from 127.0.0.2, everybody else from 127.0.0.1.

* `site`: a router, a gateway and a robot agent with ROS, each as a process.
* `scene`: two sites, and the good people of the first: a pair of headsets that talk, a headset that drives the robot,
  an operator, and a ROS node that listens to the robot's wheels. The same attack is first made on the second site, so
  that what the machine's cores are short of is measured apart from what the attack costs its victims.
* `inputs`, `floods`, `sessions`, `insiders`: the attacks, each a function in a table with who makes it and what it
  sends.
* `secured`: a policy for sites with certificates, for attackers who have one.
* `attacker`: the process that makes one of them. `raw`: a TCP agent that keeps no rule. `ways`: how it comes in.
* `judge`: what must hold, as figures with limits. Pure.
* `rights`: attacks that gain something instead of costing something, each with a site of its own.
* `chaos`: everything is killed, stopped, cut and flooded for minutes, from a seed.
"""
