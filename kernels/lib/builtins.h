// The OpenCL functions that the kernels call, declared one by one. PoCL 3 parses a megabyte of
// declarations before each program, which is four fifths of the time for one.
// clpipe/engine/programs.py disables them and defines DECLARED_HERE. On other platforms the
// compiler knows these functions, and this file is empty.
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
