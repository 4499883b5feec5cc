"""When is a particle swarm worth it?"""
