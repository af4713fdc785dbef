// The functions of OpenCL that the kernels call, declared one by one. PoCL 3 goes through a megabyte of
// declarations before each program, four fifths of its time for one; clpipe/engine/programs.py has it
// leave them out and defines DECLARED_HERE. Elsewhere the compiler knows them, and this file is empty.
#ifndef CLPIPE_BUILTINS_H
#define CLPIPE_BUILTINS_H
#ifdef DECLARED_HERE

#define DECLARE(type) type __attribute__((overloadable, const))
DECLARE(size_t) get_global_id(uint);
DECLARE(size_t) get_global_offset(uint);
DECLARE(size_t) get_global_size(uint);
DECLARE(size_t) get_local_id(uint);
DECLARE(size_t) get_local_size(uint);
DECLARE(size_t) get_group_id(uint);
DECLARE(size_t) get_num_groups(uint);
DECLARE(int) convert_int(float);
DECLARE(float) convert_float(int);
DECLARE(float) native_exp2(float);
#undef DECLARE

float __attribute__((overloadable, pure)) vload_half(size_t, const __global half *);
void __attribute__((overloadable, convergent)) barrier(uint);
uint __attribute__((overloadable)) atomic_inc(volatile __global uint *);

#endif
#endif
