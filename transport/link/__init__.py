"""How it gets there: the Zenoh session, its streams, neighbours' links, consensus rounds, injected faults."""
