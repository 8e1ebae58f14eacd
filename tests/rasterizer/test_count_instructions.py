"""The script that counts the instructions of the CUDA kernels."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))  # as Python does for a script

import count_instructions

# A loop with two exponentials of two pixels each, so it is unrolled twice, and one for the padding.
LISTING = """
	.section	.text.blend,"ax",@progbits
.text.blend:
        /*0000*/                   S2R R0, SR_TID.X ;
.L_loop:
        /*0010*/                   LDS.128 R4, [R8] ;
        /*0020*/              @P0 BRA `(.L_no_hit) ;
        /*0030*/                   FADD R1, R1, R2 ;
        /*0040*/              @P1 BRA `(.L_first) ;
        /*0050*/                   MUFU.EX2 R1, R2 ;
        /*0060*/                   FMUL R1, R1, R2 ;
.L_first:
        /*0070*/              @P2 BRA `(.L_second) ;
        /*0080*/                   MUFU.EX2 R1, R3 ;
.L_second:
        /*0090*/                   SHFL.BFLY PT, R1, R1, 0x10, 0x1f ;
.L_no_hit:
        /*00a0*/                   IADD3 R8, R8, 0x10, RZ ;
        /*00b0*/              @P3 BRA `(.L_loop) ;
        /*00c0*/                   EXIT ;
.L_end:
        /*00d0*/                   BRA `(.L_end);
        /*00e0*/                   NOP;
"""
LOG = """ptxas info    : Compiling entry function 'blend' for 'sm_90'
ptxas info    : Function properties for blend
    0 bytes stack frame, 8 bytes spill stores, 8 bytes spill loads
ptxas info    : Used 54 registers, used 1 barriers, 6144 bytes smem
"""


def test_a_loop_is_divided_into_slot_sums_and_pixels():
    (kernel,) = count_instructions.count_kernels(LISTING, LOG).values()
    assert (kernel.registers, kernel.spilled, kernel.shared) == (54, 8, 6144)
    assert kernel.instructions == 14, "without the padding"
    slots = kernel.slots
    assert (slots.slot, slots.sums, slots.pixel, slots.all) == (4, 4, 1.5, 11)
