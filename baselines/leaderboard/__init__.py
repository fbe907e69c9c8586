"""The leaderboard: fixed protocols, submissions of single policies, and their ranking."""
