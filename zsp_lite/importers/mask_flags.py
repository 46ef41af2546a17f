"""x"""
def mask_flags(frames): return ()
