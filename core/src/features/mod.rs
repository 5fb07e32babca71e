//! Numbers about the scene: names, order and units, once per volume and once per frame.
