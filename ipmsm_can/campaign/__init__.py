"""The campaign: thousands of random runs through the wire, asked one thing: is an angle called valid ever wrong?"""
