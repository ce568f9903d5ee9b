"""The neighbours' side: session, injected faults, links and credentials."""
