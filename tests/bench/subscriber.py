"""A remote client that takes everything a daemon publishes and does nothing with it."""

import argparse
import signal
import threading

import zenoh

received = 0
first = threading.Event()


def take(_sample: zenoh.Sample) -> None:
    """Count one sample."""
    global received  # noqa: PLW0603 - a program of one function
    received += 1
    first.set()


def main(endpoint: str) -> None:
    """Subscribe until terminated; every SIGUSR1 prints how many samples have come."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    config.insert_json5("connect/timeout_ms", "20000")
    config.insert_json5("connect/exit_on_failure", "true")
    session = zenoh.open(config)
    subscription = session.declare_subscriber("ldcn/bench/tele/**", take)
    first.wait(60)
    print("receiving", flush=True)
    signal.signal(signal.SIGUSR1, lambda *_: print(received, flush=True))
    while subscription:
        signal.pause()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("endpoint")
    main(parser.parse_args().endpoint)
