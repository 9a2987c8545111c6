"""negopipe"""
