"""What crosses the radio: packets, authentication, the Zenoh session, rounds, injected loss and delay.

A message (the `*_body` modules) becomes packets in `sealing.Sealer` and a message again in `opening.Opener`,
which refuses what is not authentic, new and sound. `session` carries the bytes, `channel` spoils them where
that is asked for, `rounds` waits for a round of them, `peers` keeps the books. Only `session` knows clocks
and sockets; everything else is given the time and returns values.
"""
