"""The one contract of logs and twin: signals, observation, action, reward, conditions, schema."""
