"""A valid axis file, for tests to change."""

AXIS = """\
schema: hdbridge.axis/1
name: test
bus: {interface: virtual, channel: test}
drive:
  node_id: 1
  eds: test.eds
  identity: {vendor_id: 0x4844, product_code: 0x402}
  cycle_ms: 4
  following_error_deg: 5.0
  rated_torque_nm: 0.32
motor_encoder: {counts_per_turn: 8000}
load_encoder: {counts_per_turn: 2880000, direction: -1}
gear:
  ratio: 50
limits:
  position_min_deg: -400
  position_max_deg: 400
  velocity_deg_s: 20
  acceleration_deg_s2: 200
  jerk_deg_s3: 4000
  torque_percent: 100
"""
