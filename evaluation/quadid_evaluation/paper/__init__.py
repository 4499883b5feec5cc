"""The paper's comparison: its flights, tables and figures, the swarm beside other optimisers, CVA and MOESP."""
